"""The finished semantic field: Gaussians with latents, what turns latents into features, and the one rule of what is what."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from dataclasses import field as default
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from .._card import html_card
from .._check import as_tensor, check_choice, check_shapes
from .._rows import unit_embeddings, unit_rows
from ..cameras import Camera
from ..gaussians import Gaussians
from ..labels import (
    LOGIT_SCALES,
    Classification,
    CodewordLabels,
    LabelSet,
    Score,
    Selection,
    label_codewords,
    label_pixels,
    select_by_similarity,
)
from ..labels.questions import Classes, Negatives, check_rows, class_rows, make_question
from ..metrics import MIB, semantic_storage_bytes
from ..quant import Autoencoder, Codebook, LinearLatents
from ..splat import Rendering, rasterize
from .answers import Answers, Seen, fused_answers
from .store import load_field, save_field

CHUNK = 8192  # latents decoded at once: the decoder's widest layer then holds 32 MB
Rule = Literal["fused", "paper"]
RULES: tuple[Rule, ...] = ("fused", "paper")


@dataclass(frozen=True, eq=False)
class SemanticField:
    """A scene's semantics in 3-D, and everything that is needed to ask it.

    Latents are linear in the teacher's features (`linear`, what `uplift` makes), or one of the three rows of Table 1: with
    codebook and autoencoder d latents ("decouple+ADC+SC"), with the codebook alone features near codewords
    ("decouple+ADC"), with neither the teacher's features as they are ("just decouple").

    **The rule.** Each Gaussian has a class, or a score, of its own: that of its *fused* feature, the mean of what the
    training views show where it is seen. Selections, labels of other clouds, and the views of a fused field follow from it.
    `rule="paper"` is Sec. 3.4 as printed: a Gaussian's own latent, or a pixel's rendered one, is decoded and quantised.
    """

    gaussians: Gaussians
    codebook: Codebook | None = None
    autoencoder: Autoencoder | None = None
    info: dict[str, Any] = default(default_factory=dict)
    """Where it comes from; anything that JSON can hold."""
    linear: LinearLatents | None = None
    """What linear latents stand for: `answers` where there are some, else the Gaussians' features."""
    answers: Tensor | None = None  # [N, e]
    """Each Gaussian's fused feature, as linear latents; None where the Gaussians' features are just that."""
    seen: Seen | None = None
    """How well the training views show each Gaussian."""
    cameras: tuple[Camera, ...] = ()
    """The training views, undistorted."""
    folder: Path | None = None
    """Where it was loaded from."""

    def __post_init__(self) -> None:
        if self.gaussians.features is None:
            raise ValueError("gaussians: expected features [N, d], got None; fit them with fit_field")
        if self.autoencoder is not None and self.codebook is None:
            raise ValueError("codebook: expected the one that the autoencoder was fitted to, got None; pass it as well")
        if self.linear is None and self.answers is not None:
            raise ValueError("linear: expected what the answers stand for, got None; pass it as well")
        if self.linear is not None:
            check_shapes(
                ("gaussians.means", self.gaussians.means, "N 3"),
                ("gaussians.features" if self.answers is None else "answers", self._own, ("N", self.linear.latent)),
            )
            if self.answers is None and self.codebook is not None:
                raise ValueError(
                    "codebook: expected none for linear latents, got one; pass answers, or leave linear out"
                )
        if self.codebook is None:
            return
        expected = self.codebook.dim if self.autoencoder is None else self.autoencoder.latent
        if self.autoencoder is not None and self.autoencoder.dim != self.codebook.dim:
            raise ValueError(
                f"autoencoder: expected {self.codebook.dim} decoded channels (from codebook), got {self.autoencoder.dim}; "
                "pass the autoencoder that was fitted to this codebook"
            )
        if expected != self.channels:
            raise ValueError(
                f"gaussians: expected {expected} features each (from the codebook's latents), got {self.channels}; "
                "pass the codebook and autoencoder that this field was fitted with"
            )

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
        if self._is_linear:
            assert self.linear is not None
            return self.linear.dim
        return self.channels if self.codebook is None else self.codebook.dim

    @property
    def method(self) -> str:
        """Either "fused", or the row of Table 1."""
        if self._is_linear:
            return "fused"
        row = "just decouple" if self.codebook is None else "decouple+ADC"
        return row + ("+SC" if self.autoencoder is not None else "")

    @property
    def known(self) -> Tensor:  # [N] bool
        """Which Gaussians a training view has shown: the others have learnt nothing, and belong to no class."""
        return self._own.any(dim=1)

    def __len__(self) -> int:
        return len(self.gaussians)

    def __repr__(self) -> str:
        return f"SemanticField({self.method}: {len(self)} Gaussians, {self.channels} channels for {self.dim})"

    def _repr_html_(self) -> str:
        teacher = self.info.get("teacher")
        facts = {
            "method": self.method,
            "Gaussians": len(self),
            "channels": f"{self.channels} for {self.dim} of the teacher",
            "codewords": None if self.codebook is None else self.codebook.size,
            "training views": len(self.cameras) or None,
            "size (as Table 1 counts it)": f"{self.storage() / MIB:.2f} MiB",
            "teacher": teacher.get("name") if isinstance(teacher, dict) else None,
            "folder": None if self.folder is None else str(self.folder),
        }
        return html_card("SemanticField", facts)

    # Maps

    def render(self, camera: Camera, *, engine: str = "auto") -> Rendering:
        """The latent map F_r (Eq. 3) from a viewpoint, with its alpha. No gradient."""
        with torch.no_grad():
            return rasterize(self.gaussians, camera, engine=engine)

    def decode(
        self,
        latents: Tensor,  # [..., d]
    ) -> Tensor:  # [..., D]
        """Bring latents back to the teacher's space (Psi of Sec. 3.3.2, or B z); features are returned as they are."""
        latents = as_tensor("latents", latents, floating=True)
        if latents.shape[-1] != self.channels:
            raise ValueError(
                f"latents: expected [..., d] with d = {self.channels} (from gaussians), got {tuple(latents.shape)}; "
                "pass maps or features of this field"
            )
        with torch.no_grad():
            if self._is_linear:
                assert self.linear is not None
                return self.linear.decode(latents)
            return latents if self.autoencoder is None else self.autoencoder.decode(latents, chunk=CHUNK)

    def feature_map(self, camera: Camera) -> Tensor:  # [H, W, D]
        """The teacher's features as seen from a viewpoint. 512 channels at 640x480 take 630 MB."""
        return self.decode(self.render(camera).map)

    # The rule

    def cosines(
        self,
        rows: Tensor,  # [M, D]
        *,
        rule: Rule = "fused",
    ) -> Tensor:  # [N, M]
        """The cosine of each Gaussian's feature with some rows; 0 where nothing is known of the Gaussian.

        Args:
            rows: embeddings in the teacher's space, of any length.
            rule: `fused`: its fused feature. `paper`: the codeword nearest to its own decoded latent (Sec. 3.4). A field
                that was made without its training views has no fused features, and follows the paper either way.

        Raises:
            ValueError: if there is no row, shapes disagree, or a row is all-zero.
        """
        check_choice("rule", rule, RULES)
        rows = as_tensor("rows", rows, floating=True)
        check_rows("rows", rows, ("M",), self.dim)
        unit = unit_embeddings(rows, "rows").to(self.features)
        with torch.no_grad():
            if self.linear is not None and (rule == "fused" or self._is_linear):
                return self.linear.cosines(self._own, unit)
            if self.codebook is None:
                return torch.cat([unit_rows(part) @ unit.T for part in self.features.split(CHUNK)])
            per_codeword = self.codebook.unit.to(unit) @ unit.T  # [K, M]
            index = [self.codebook.quantize(self.decode(part)) for part in self.features.split(CHUNK)]
            return per_codeword[torch.cat(index)] * self.features.any(dim=1)[:, None]

    def own_features(
        self,
        rows: Tensor,  # [n] int64
    ) -> Tensor:  # [n, D]
        """The features that some Gaussians answer with, in the teacher's space; all-zero where nothing is known."""
        if self.linear is not None:
            return self.linear.decode(self._own[rows])
        return self.decode(self.features[rows]) * self.known[rows, None]

    def classify(self, classes: Classes | None = None, *, rule: Rule = "fused") -> Classification:
        """The class of each Gaussian by max-similarity (Sec. 3.4), and its cosine with that class.

        Args:
            classes: a label set, or embeddings [C, D]; None: the field's own (`label_set`).
            rule: see `cosines`.

        Returns:
            Labels [N], -1 where nothing is known of the Gaussian, and scores [N]. A tie goes to the lowest class.
        """
        cosines = self.cosines(self._rows(classes), rule=rule)
        scores, labels = cosines.max(dim=1)
        nothing = ~(self.known if rule == "fused" else self.features.any(dim=1))
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
        """The Gaussians of one thing: those that are more like it than a threshold (gamma of Sec. 3.4).

        By default they are those that are more like the target than like anything that it is compared with: the other classes
        for a class, the canonical words for anything else. The score is then a relevancy (`labels.relevancy`), gamma 0.5.

        Args:
            target: the name of a class, or an embedding [D].
            classes: where the name is looked up, and what it is compared with; None: the field's own (`label_set`).
            threshold: gamma. None: 0.5 for a relevancy, else read off the scores; the result says how.
            negatives: what the target is compared with: "classes", "canonical" (words of the classes' table), "none", rows
                [M, D], or "auto" as above.
            score: "relevancy", "softmax" over target and negatives, or "cosine"; None: relevancy with negatives, else
                cosine.
            logit_scale: of the softmax: "raw", "lseg", "clip", or a number that multiplies the cosines.
            rule: see `cosines`.

        Raises:
            ValueError: if there is no such class, shapes disagree, a row is all-zero, or an option is unknown.
        """
        if not isinstance(target, str):
            target = as_tensor("target", target, floating=True)
        if score == "cosine" and isinstance(negatives, str) and negatives == "auto":
            negatives = "none"
        compared = isinstance(negatives, str) and negatives != "none"  # from something that the classes' files hold
        if classes is None and (isinstance(target, str) or (compared and "classes" in self.info)):
            try:
                classes = self.label_set()
            except (FileNotFoundError, ValueError):
                if isinstance(target, str) or negatives != "auto":  # an embedding needs no classes
                    raise
        asked = make_question(target, classes, negatives, self.dim, self.info)
        rows = (
            asked.row[None] if asked.negatives is None else torch.cat([asked.row[None], asked.negatives.to(asked.row)])
        )
        cosines = self.cosines(rows, rule=rule)
        known = self.known if rule == "fused" else self.features.any(dim=1)
        against = None if asked.negatives is None else cosines[:, 1:]
        return select_by_similarity(cosines[:, 0], against, threshold, known, score=score, logit_scale=logit_scale)

    def segment(
        self, camera: Camera, classes: Classes | None = None, *, rule: Rule = "fused"
    ) -> Tensor:  # [H, W] int64
        """The class of each pixel from a viewpoint; -1 where nothing was drawn.

        Args:
            camera: any viewpoint.
            classes: a label set, or embeddings [C, D]; None: the field's own (`label_set`).
            rule: `fused`: each Gaussian of a fused field shares one vote among the classes (the softmax of 100 cosines,
                CLIP's scale), and a pixel takes the class with most votes, as blended; a trained field, which learnt
                blends of latents, takes the codeword whose latent is nearest to the rendered one. `paper`: render the
                latent map, decode every pixel, quantise, look up (Sec. 3.4). Features without an autoencoder need no codeword:
                the class most similar to the rendered feature wins, quantised first only by the paper's rule.

        Raises:
            ValueError: if shapes disagree or `rule` is unknown.
        """
        check_choice("rule", rule, RULES)
        rows = self._rows(classes)
        if rule == "fused" and self._is_linear:
            return self._blend_votes(camera, rows)
        rendering = self.render(camera)
        if self.codebook is None or (rule == "fused" and self.autoencoder is None):
            pixels = [self.decode(part) for part in rendering.map.flatten(0, 1).split(CHUNK)]
            unit = unit_embeddings(rows).to(self.features)
            found = torch.cat([(part @ unit.T).max(dim=1).indices.masked_fill(~part.any(dim=1), -1) for part in pixels])
            return found.view(camera.size).masked_fill(rendering.alpha <= 0, -1)
        labels = self.codeword_labels(rows)
        decode: Literal["exact", "latent"] = "exact" if rule == "paper" else "latent"
        covered = rendering.alpha > 0
        return label_pixels(rendering.map, self.codebook, labels, self.autoencoder, decode=decode, covered=covered)

    def _blend_votes(self, camera: Camera, rows: Tensor) -> Tensor:  # [C, D] -> [H, W] int64
        with torch.no_grad():
            cosines = self.cosines(rows)
            winners = cosines.argmax(dim=1)[self.known].unique()  # a class that no Gaussian prefers wins no pixel
            if len(winners) == 0:
                return torch.full(camera.size, -1, dtype=torch.int64, device=self.features.device)
            votes = torch.softmax(LOGIT_SCALES["clip"] * cosines[:, winners], dim=1) * self.known[:, None]
            blended = rasterize(self.gaussians.replace(features=votes.contiguous(), sh=None), camera).map
            most, index = blended.max(dim=-1)
            return winners[index].masked_fill(most <= 0, -1)

    def codeword_labels(
        self,
        embeddings: Tensor,  # [C, D]
    ) -> CodewordLabels:
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
        """This field with fused features found from some views, which it remembers. A fused field has its own.

        Args:
            cameras: those that the field was trained with.
            found: what `fused_answers` gave; None asks it.

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
        """The classes that the field remembers from its scene.

        Raises:
            ValueError: if it remembers none, or they have changed.
            FileNotFoundError: if they are no longer where they were.
        """
        from .remembered import recall_classes

        return recall_classes(self.info, self.folder)

    # Size and files

    def storage(self) -> int:
        """Bytes as Table 1 counts them: every attribute of the Gaussians, and what decodes them, in float32.

        With no autoencoder the table's sizes hold no codebook or decoder; ours counts the codebook, which labelling needs.
        Fused answers of a trained field are not counted.
        """
        decoder = 0 if self.autoencoder is None else self.autoencoder.decoder_parameters
        codebook = 0 if self.codebook is None else self.codebook.codewords.numel()
        basis = self.linear.basis.numel() if self._is_linear and self.linear is not None else 0
        return semantic_storage_bytes(len(self), self.channels, decoder, codebook + basis)

    def summary(self) -> str:
        """A few lines for a person: counts, channels, codewords, size."""
        codewords = "no codebook" if self.codebook is None else f"{self.codebook.size} codewords"
        teacher = self.info.get("teacher")
        lines = [
            f"semantic field ({self.method}): {len(self)} Gaussians, {self.channels} channels for {self.dim}, {codewords}",
            f"  size as Table 1 counts it: {self.storage() / MIB:.2f} MiB",
            *([f"  teacher: {teacher.get('name')}"] if isinstance(teacher, dict) else []),
            *(f"  {name}: {value}" for name, value in self.info.items() if not isinstance(value, list | dict)),
        ]
        return "\n".join(lines)

    def save(self, path: str | Path) -> None:
        """Write a folder with `field.safetensors` and `field.json`, whole or not at all; an older field is replaced.

        Raises:
            FileExistsError: if something else than a field lies at `path`.
            ValueError: if `info` is not JSON.
        """
        save_field(path, self)

    @classmethod
    def load(cls, path: str | Path) -> SemanticField:
        """Read what `save` wrote.

        Raises:
            FileNotFoundError: if there is no field at `path`.
            ValueError: if it is damaged, from another version, or something else.
        """
        return cls(**load_field(path), folder=Path(path))

    @property
    def _is_linear(self) -> bool:
        return self.linear is not None and self.answers is None

    @property
    def _own(self) -> Tensor:  # [N, e]
        return self.features if self.answers is None else self.answers

    def _rows(self, classes: Classes | None) -> Tensor:  # [C, D]
        if isinstance(classes, str):
            raise TypeError(
                f"classes: expected a LabelSet or embeddings [C, {self.dim}], got the name {classes!r}; "
                f"query({classes!r}) finds the Gaussians of one class"
            )
        if isinstance(classes, np.ndarray):
            classes = as_tensor("classes", classes, floating=True)
        return class_rows(self.label_set() if classes is None else classes, self.dim, self.info)
