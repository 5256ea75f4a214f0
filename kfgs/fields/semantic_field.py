"""The finished semantic field: Gaussians with latents, their decoder, and the rule that gives each Gaussian a class."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from dataclasses import field as default
from pathlib import Path
from typing import Any, get_args

import torch
from torch import Tensor

from .._card import html_card
from .._check import as_tensor, check_choice
from .._files import as_path
from .._rows import unit_embeddings
from .._typed import typed
from ..cameras import Camera
from ..gaussians import Gaussians, as_rows
from ..labels import Classification, CodewordLabels, LabelSet, Score, Selection, label_codewords, select_by_similarity
from ..labels.questions import Classes, Negatives, check_rows, class_rows, make_question
from ..quant import Autoencoder, Codebook, LinearLatents
from ..splat import Ranked, Rendering, rasterize
from . import parts
from .answers import Answers, Seen, fused_answers
from .precision import PrecisionName, Rounding
from .remembered import recall_classes
from .store import load_field, save_field
from .views import Rule, rank_classes


@typed
@dataclass(frozen=True, eq=False)
class SemanticField:
    """The result of a fit: find things (`query`), give each Gaussian a class (`classify`) or each pixel (`segment`).

    `field.gaussians[field.query("chair")]` are the Gaussians of the chair.

    **Latents.** A Gaussian holds d numbers. They are linear in the teacher's features (`linear`, made by `uplift`), or as in
    one of the three rows of Table 1: with codebook and autoencoder, d latents ("decouple+ADC+SC"); with the codebook
    only, features near codewords ("decouple+ADC"); with neither, the teacher's features ("just decouple").

    **The rule.** The class or score of a Gaussian is that of its *fused* feature: the mean over the pixels of the training
    views that show it. Selections, labels of other clouds, and the views of a fused field follow from it. `rule="paper"` is
    Sec. 3.4 as printed: decode and quantise a Gaussian's own latent, or a pixel's rendered one.
    """

    gaussians: Gaussians
    codebook: Codebook | None = None
    autoencoder: Autoencoder | None = None
    info: dict[str, Any] = default(default_factory=dict)
    """The origin of the field, as JSON."""
    linear: LinearLatents | None = None
    """Decodes linear latents: `answers` if there are any, else the Gaussians' features."""
    answers: Tensor | None = None  # [N, e]
    """Each Gaussian's fused feature, as linear latents; None if the Gaussians' features are already fused."""
    seen: Seen | None = None
    """How well the training views show each Gaussian."""
    cameras: tuple[Camera, ...] = ()
    """The training views, undistorted."""
    words: LabelSet | None = None
    """The classes of its scene with their text table, if the field holds them itself."""
    folder: Path | None = None
    """The folder or file it was loaded from."""

    def __post_init__(self) -> None:
        parts.check_parts(self.gaussians, self.codebook, self.autoencoder, self.linear, self.answers, self.seen)

    @property
    def features(self) -> Tensor:  # [N, d]
        """The Gaussians' latents (or features, of a field without compression)."""
        assert self.gaussians.features is not None
        return self.gaussians.features

    @property
    def channels(self) -> int:
        """d, the channels of a Gaussian."""
        return int(self.features.shape[1])

    @property
    def dim(self) -> int:
        """D, the channels of the teacher's features."""
        if self.linear is not None and self._is_linear:
            return self.linear.dim
        return self.channels if self.codebook is None else self.codebook.dim

    @property
    def method(self) -> str:
        """Either "fused", or the row of Table 1."""
        if self._is_linear:
            return "fused"
        return "just decouple" if self.codebook is None else "decouple+ADC" + ("+SC" if self.autoencoder else "")

    @property
    def known(self) -> Tensor:  # [N] bool
        """Which Gaussians a training view has shown; nothing is known about the others, so they have no class."""
        return self._own.any(dim=1)

    def __len__(self) -> int:
        return len(self.gaussians)

    def __repr__(self) -> str:
        return f"SemanticField({self.method}: {len(self)} Gaussians, {self.channels} channels for {self.dim})"

    def _repr_html_(self) -> str:
        return html_card("SemanticField", parts.card_facts(self))

    def to(self, *args: Any, **kwargs: Any) -> SemanticField:
        """The field on another device or in another dtype; the arguments are those of `torch.Tensor.to`.

        Cameras that you pass to `segment` and `render` afterwards must be on the same device. `folder` stays.
        """
        names = ("gaussians", "codebook", "autoencoder", "linear", "answers", "seen")
        moved = {name: part.to(*args, **kwargs) for name in names if (part := getattr(self, name)) is not None}
        return replace(self, **moved, cameras=tuple(camera.to(*args, **kwargs) for camera in self.cameras))

    # Maps

    @typed
    def render(self, camera: Camera, *, engine: str = "auto") -> Rendering:
        """The latent map F_r (Eq. 3) from a viewpoint, with its alpha. No gradient."""
        with torch.no_grad():
            return rasterize(self.gaussians, camera, engine=engine)

    def decode(self, latents: Tensor) -> Tensor:  # [..., d] -> [..., D]
        """Decode latents to the teacher's space (Psi of Sec. 3.3.2, or B z); features are returned unchanged."""
        with torch.no_grad():
            return parts.decode_latents(self, as_tensor("latents", latents, floating=True))

    def feature_map(self, camera: Camera) -> Tensor:  # [H, W, D]
        """Render the teacher's features from a viewpoint. 512 channels at 640x480 take 630 MB."""
        return self.decode(self.render(camera).map)

    # The rule

    def cosines(self, rows: Tensor, *, rule: Rule = "fused") -> Tensor:  # [M, D] -> [N, M]
        """The cosine of each Gaussian's feature with some rows; 0 if nothing is known about the Gaussian.

        Args:
            rows: embeddings in the teacher's space, of any length.
            rule: `fused`: its fused feature. `paper`: the codeword nearest to its own decoded latent (Sec. 3.4). A field
                made without its training views has no fused features, and always follows the paper.

        Raises:
            ValueError: if there is no row, shapes disagree, or a row is all-zero.
        """
        check_choice("rule", rule, get_args(Rule))
        rows = as_tensor("rows", rows, floating=True)
        check_rows("rows", rows, ("M",), self.dim)
        unit = unit_embeddings(rows, "rows").to(self.features)
        with torch.no_grad():
            if self.linear is not None and (rule == "fused" or self._is_linear):
                return self.linear.cosines(self._own, unit)
            return parts.latent_cosines(self, unit)

    def own_features(self, rows: Tensor) -> Tensor:  # [n] int64 -> [n, D]
        """The features of some Gaussians by the rule, all-zero if unknown. Rows and errors: see `Gaussians.select`."""
        rows = as_rows("rows", rows, len(self)).to(self.features.device)
        if self.linear is not None:
            return self.linear.decode(self._own[rows])
        return self.decode(self.features[rows]) * self.known[rows, None]

    def classify(self, classes: Classes | None = None, *, rule: Rule = "fused") -> Classification:
        """The class of each Gaussian by max-similarity (Sec. 3.4), and its cosine with that class.

        Args:
            classes: a label set, or embeddings [C, D]; None: the field's own (`label_set`).
            rule: see `cosines`.

        Returns:
            Labels [N], -1 if nothing is known about the Gaussian, and scores [N]. A tie goes to the lowest class.
        """
        scores, labels = self.cosines(self._rows(classes), rule=rule).max(dim=1)
        nothing = ~self._known(rule)
        return Classification(labels.masked_fill(nothing, -1), scores.masked_fill(nothing, 0))

    def label(self, classes: Classes | None = None, *, rule: Rule = "fused") -> Gaussians:
        """The Gaussians with the labels of `classify`."""
        return self.gaussians.replace(labels=self.classify(classes, rule=rule).labels)

    def query(
        self,
        target: str | Tensor,
        classes: Classes | None = None,
        threshold: float | None = None,
        *,
        negatives: Negatives | Tensor = "auto",
        score: Score | None = None,
        logit_scale: float | str = "clip",
        rule: Rule = "fused",
    ) -> Selection:
        """The Gaussians of one thing: those with a score above a threshold (gamma of Sec. 3.4).

        By default a Gaussian is selected if it is more similar to the target than to all negatives: the other classes for a
        class, the canonical words for any other target. The score is then a relevancy (`labels.relevancy`), gamma 0.5.

        Args:
            target: the name of a class, or an embedding [D].
            classes: to look up the name and for the negatives; None: the field's own (`label_set`).
            threshold: gamma. None: 0.5 for a relevancy, else derived from the scores; `how` of the result explains it.
            negatives: "classes", "canonical" (words of the classes' table), "none", rows [M, D], or "auto" as above.
            score: "relevancy", "softmax" over target and negatives, or "cosine". None: relevancy if there are negatives.
            logit_scale: for the softmax: "raw", "lseg", "clip", or a number that multiplies the cosines.
            rule: see `cosines`.

        Raises:
            ValueError: if there is no such class, shapes disagree, a row is all-zero, or an option is unknown.
        """
        if not isinstance(target, str):
            target = as_tensor("target", target, floating=True)
        if score == "cosine" and isinstance(negatives, str) and negatives == "auto":
            negatives = "none"
        classes = parts.classes_to_ask(self, target, negatives) if classes is None else classes
        asked = make_question(target, classes, negatives, self.dim, self.info)
        cosines = self.cosines(asked.rows, rule=rule)
        against = None if asked.negatives is None else cosines[:, 1:]
        options: dict[str, Any] = {"score": score, "logit_scale": logit_scale}
        return select_by_similarity(cosines[:, 0], against, threshold, self._known(rule), **options)

    @typed
    def segment(
        self, camera: Camera, classes: Classes | None = None, *, rule: Rule = "fused"
    ) -> Tensor:  # [H, W] int64
        """The class of each pixel from a viewpoint; -1 for empty pixels.

        Args:
            camera: any viewpoint.
            classes: a label set, or embeddings [C, D]; None: the field's own (`label_set`).
            rule: `fused`: in a fused field each Gaussian divides one vote among the classes (the softmax of 100 times the
                cosines, CLIP's scale), and a pixel takes the class with most blended votes. A trained field has learnt
                blends of latents, so a pixel takes the codeword with the latent nearest to the rendered one. `paper`: render
                the latent map, decode every pixel, quantise, look up (Sec. 3.4). Without an autoencoder, the class most
                similar to the rendered feature wins; only `paper` quantises it first.

        Raises:
            ValueError: if shapes disagree or `rule` is unknown.
        """
        return rank_classes(self, camera, self._rows(classes), rule, early=True).labels[..., 0]

    def rank(self, camera: Camera, classes: Classes | None = None, *, top: int = 1, rule: Rule = "fused") -> Ranked:
        """The `top` best classes of each pixel by the rule of `segment`, and their scores.

        Args:
            camera: any viewpoint.
            classes: as in `segment`.
            top: how many classes, from 1 to C.
            rule: as in `segment`.

        Returns:
            Labels and scores [H, W, top], the best first; -1 and 0 where there is no class. And the opacity [H, W]. Scores are
            blended votes, from 0 to 1; of a trained field with codewords, cosines of the pixel's codeword with the classes;
            without codewords, by the rule `paper`, numbers that only compare the classes of one pixel.

        Raises:
            ValueError: as `segment`, and if `top` is out of range.
        """
        return rank_classes(self, camera, self._rows(classes), rule, top)

    def codeword_labels(self, embeddings: Tensor) -> CodewordLabels:  # [C, D]
        """The class of each codeword (Sec. 3.4).

        Raises:
            ValueError: if the field has no codebook, or shapes disagree.
        """
        embeddings = as_tensor("embeddings", embeddings, floating=True)
        check_rows("embeddings", embeddings, ("C",), self.dim)
        if self.codebook is None:
            raise ValueError("codebook: expected one, got None in this field; use classify or segment, which need none")
        return label_codewords(self.codebook.codewords, embeddings)

    def with_answers(self, cameras: Sequence[Camera], found: Answers | None = None) -> SemanticField:
        """Add fused features computed from views, and these views. A fused field keeps its features.

        Args:
            cameras: the training views.
            found: the result of `fused_answers`; None calls it.

        Raises:
            ValueError: if there is no camera.
        """
        if not cameras:
            raise ValueError("cameras: expected at least one, got none; pass those that the field was trained with")
        if not self._is_linear:
            found = found or fused_answers(self.gaussians, self.codebook, self.autoencoder, cameras)
            self = replace(self, answers=found.latents, linear=found.linear, seen=found.seen)
        return replace(self, cameras=tuple(cameras))

    def label_set(self) -> LabelSet:
        """The classes that the field holds or remembers from its scene.

        Raises:
            ValueError: if there are none, or they have changed.
            FileNotFoundError: if their files are missing.
        """
        return recall_classes(self.info, self.folder) if self.words is None else self.words

    @property
    def has_classes(self) -> bool:
        """Whether the field holds classes, or remembers where they are."""
        return self.words is not None or "classes" in self.info

    # Size and files

    def storage(self) -> int:
        """Bytes as in Table 1: every attribute of the Gaussians, and their decoder, in float32.

        Without an autoencoder, the table counts no codebook; here it counts, because labelling needs it. Fused answers do
        not count.
        """
        return parts.storage_bytes(self)

    def summary(self) -> str:
        """A few lines of text: counts, channels, codewords, size."""
        return parts.summary_text(self)

    def save(self, path: str | Path, precision: PrecisionName | Rounding | None = None) -> None:
        """Write a folder (`field.safetensors` and `field.json`), or one file if `path` ends in `.kfgs.safetensors`.

        It is written whole or not at all; an older field is replaced. One file also holds the classes and their text table.

        Args:
            path: of the folder or file.
            precision: of one file: "lossless" (the default), "fine", "small", "tiny" or your own `Rounding`. All but the first
                sort the Gaussians, and note their errors in `info["rounded"]`.

        Raises:
            FileExistsError: if there is something other than a field at `path`.
            ValueError: if `info` is not JSON, the precision is unknown, or a folder gets one. For one file also if a number is
                not finite, an opacity lies outside [0, 1], a scale is negative, or a number is too large to be rounded.
        """
        save_field(path, vars(self), precision)

    @classmethod
    def load(cls, path: str | Path) -> SemanticField:
        """Read what `save` wrote; a FileNotFoundError if nothing is there, a ValueError if it is no field or damaged."""
        return cls(**load_field(path), folder=as_path(path))

    @property
    def _is_linear(self) -> bool:
        return self.linear is not None and self.answers is None

    @property
    def _own(self) -> Tensor:  # [N, e]
        return self.features if self.answers is None else self.answers

    def _known(self, rule: Rule) -> Tensor:  # [N] bool
        return self.known if rule == "fused" else self.features.any(dim=1)

    def _rows(self, classes: Classes | None) -> Tensor:  # [C, D]
        return class_rows(self.label_set() if classes is None else parts.checked_classes(classes), self.dim, self.info)
