"""The finished semantic field: Gaussians with latents, their decoder, and the questions that it answers (Sec. 3.4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from .._card import html_card
from .._check import as_tensor, check_shapes, check_whole
from .._rows import unit_embeddings
from ..cameras import Camera, Cameras, as_cameras
from ..cameras.camera import view_named
from ..gaussians import Gaussians, as_rows
from ..labels import LabelSet, Part, Selection, connected_parts, number_instances
from ..labels.classify import Classification
from ..labels.label_set import Classes, Negatives, check_rows, class_rows, make_question
from ..labels.scores import Score
from ..labels.selection import select_by_similarity
from ..metrics import MIB, semantic_storage_bytes
from ..splat import Rendering, rasterize
from ..splat.engines.contract import Ranked
from ..splat.rasterize import Votes, rank_votes
from .decoders import Decoder
from .packing import Precision
from .store import load_field, save_field

_VOTES: WeakKeyDictionary[Any, tuple[Any, Tensor, Votes]] = WeakKeyDictionary()
"""Votes depend on the text alone, so the last ones of each field are kept, with the text they answer."""


@dataclass(frozen=True, eq=False)
class SemanticField:
    """The result of a fit: find things (`query`), give each Gaussian a class (`classify`) or each pixel (`segment`).

    `field.gaussians[field.query("chair")]` are the Gaussians of the chair, `field[...]` is the field of them.

    **The rule.** The class or score of a Gaussian is that of its *fused* feature: the mean over the pixels of the training
    views that show it. A field made by `uplift_maps` has these as its latents. A trained field holds them as a second field of
    the same Gaussians, `fused`, which answers for them. A pixel is answered by rendering the field's own latents, never
    `fused` (`decoders.py` has the rules). `field.paper` answers by Sec. 3.4 as printed: decode and quantise a Gaussian's own
    latent, or a pixel's rendered one.
    """

    gaussians: Gaussians
    """With latents as features [N, d]."""
    decoder: Decoder
    """What the latents mean: `Linear`, or one of the rows of Table 1 (`Identity`, `Codewords`, `Autoencoded`)."""
    cameras: tuple[Camera, ...] = ()
    """The training views, undistorted."""
    classes: LabelSet | None = None
    """The classes of its scene with their text table."""
    info: dict[str, Any] = field(default_factory=dict)
    """The origin of the field, as JSON."""
    fused: SemanticField | None = None
    """The fused features of a trained field (`fuse_views`), with a `Linear` decoder."""
    names = property(lambda self: () if self.classes is None else self.classes.names, doc="The names of its classes.")

    def __post_init__(self) -> None:
        if self.gaussians.features is None:
            raise ValueError("gaussians: expected features [N, d], got None; fit them with fit_field")
        check_shapes(("gaussians.features", self.gaussians.features, ("N", self.decoder.latent)))
        if self.fused is not None and (len(self.fused) != len(self) or self.fused.dim != self.dim):
            raise ValueError(f"fused: expected a field of the same Gaussians and teacher, got {self.fused!r}")

    @property
    def latents(self) -> Tensor:  # [N, d]
        """What the Gaussians carry, `gaussians.features`; the decoder makes features [N, D] of them."""
        assert self.gaussians.features is not None
        return self.gaussians.features

    @property
    def dim(self) -> int:
        """D, the channels of the teacher's features."""
        return self.decoder.dim

    @property
    def known(self) -> Tensor:  # [N] bool
        """Which Gaussians a training view has shown; nothing is known about the others, so they have no class."""
        return self._source.latents.any(dim=1)

    @property
    def _source(self) -> SemanticField:
        """The field that answers for the Gaussians: the fused one, if there is one."""
        return self if self.fused is None else self.fused

    @property
    def paper(self) -> SemanticField:
        """The same field, which answers by Sec. 3.4 as printed: without fused features, every pixel decoded."""
        decoder: Any = self.decoder
        return replace(self, fused=None, decoder=replace(decoder, paper=True))

    def __len__(self) -> int:
        return len(self.gaussians)

    def __repr__(self) -> str:
        channels = f"{self.latents.shape[1]} channels for {self.dim}"
        return f"SemanticField({self.decoder.name}: {len(self)} Gaussians, {channels})"

    def _facts(self) -> dict[str, Any]:
        teacher, rounded = self.info.get("teacher"), self.info.get("rounded", ())
        plain = {name: value for name, value in self.info.items() if not isinstance(value, list | dict)}
        return {
            "size as Table 1 counts it": f"{self.storage() / MIB:.2f} MiB",
            "teacher": teacher.get("name") if isinstance(teacher, dict) else None,
            "training views": len(self.cameras),
            "classes": None if self.classes is None else f"{len(self.classes)}, with their text table",
            "rounded": ", ".join(str(entry["precision"]) for entry in rounded) or None,
        } | plain

    def _repr_html_(self) -> str:
        return html_card(repr(self), self._facts())

    def summary(self) -> str:
        """A few lines of text: counts, channels, size, origin."""
        facts = {name: value for name, value in self._facts().items() if value is not None}
        return "\n".join([repr(self), *(f"  {name}: {value}" for name, value in facts.items())])

    def to(self, *args: Any, **kwargs: Any) -> SemanticField:
        """The field on another device or in another dtype, as `torch.Tensor.to`; cameras that you pass must be there, too."""
        parts = {name: getattr(self, name) for name in ("gaussians", "decoder", "fused")}
        moved = {name: part.to(*args, **kwargs) for name, part in parts.items() if part is not None}
        return replace(self, **moved, cameras=tuple(camera.to(*args, **kwargs) for camera in self.cameras))

    def select(self, which: Any) -> SemanticField:
        """A field of some of its Gaussians, with all that is known about them. Rows and errors: see `Gaussians.select`."""
        rows = as_rows("which", which, self)
        fused = None if self.fused is None else self.fused.select(rows)
        return replace(self, gaussians=self.gaussians.select(rows), fused=fused)

    __getitem__ = select

    # Maps

    def render(self, camera: Cameras | str, *, engine: str = "auto") -> Rendering:
        """The latent map F_r (Eq. 3) from a viewpoint, with its alpha. No gradient.

        Here and below, a viewpoint is a camera, or the name of one of the field's own: `field.segment("f01")`; `render` and
        `segment` also take several of one size, as a list or kornia's `PinholeCamera`.
        """
        with torch.no_grad():
            return rasterize(self.gaussians, view_named(self.cameras, camera, "camera"), engine=engine)

    def decode(self, latents: Tensor) -> Tensor:  # [..., d] -> [..., D]
        """Decode latents to the teacher's space (Psi of Sec. 3.3.2, or B z); features are returned unchanged."""
        with torch.no_grad():
            return self.decoder.decode(as_tensor("latents", latents, floating=True))

    def feature_map(self, camera: Camera | str) -> Tensor:  # [H, W, D]
        """Render the teacher's features from a viewpoint. 512 channels at 640x480 take 630 MB."""
        return self.decode(self.render(camera).map)

    # Answers

    def cosines(self, rows: Tensor) -> Tensor:  # [M, D] -> [N, M]
        """The cosine of each Gaussian's feature with some rows in the teacher's space; 0 if nothing is known about it."""
        rows = as_tensor("rows", rows, floating=True)
        check_rows("rows", rows, ("M",), self.dim)
        source = self._source
        with torch.no_grad():
            return source.decoder.cosines(source.latents, unit_embeddings(rows, "rows").to(source.latents))

    def features_of(self, rows: Any) -> Tensor:  # [n, D]
        """The features of some Gaussians, all-zero if unknown. Rows and errors: see `Gaussians.select`."""
        latents = self._source.latents[as_rows("rows", rows, self).to(self.latents.device)]
        return self._source.decode(latents) * latents.any(dim=1)[:, None]

    def classify(self, classes: Classes | None = None) -> Classification:
        """The class of each Gaussian by max-similarity (Sec. 3.4), and its cosine with that class.

        `classes` are a label set, or embeddings [C, D]; None: the field's own. Labels [N] are -1 where nothing is known about
        the Gaussian. A tie goes to the lowest class.
        """
        (scores, labels), unknown = self.cosines(self._rows(classes)).max(dim=1), ~self.known
        return Classification(labels.masked_fill(unknown, -1), scores.masked_fill(unknown, 0))

    def label(self, classes: Classes | None = None) -> Gaussians:
        """The Gaussians with the labels and scores of `classify`, and the names of the classes, if they are known."""
        classes = self.classes if classes is None else classes
        labels, scores = self.classify(classes)
        names = classes.names if isinstance(classes, LabelSet) else ()
        return self.gaussians.replace(labels=labels, scores=scores, names=names)

    def query(
        self,
        target: str | Tensor,
        classes: Classes | None = None,
        threshold: float | None = None,
        *,
        negatives: Negatives | Tensor = "auto",
        score: Score | None = None,
    ) -> Selection:
        """The Gaussians of one thing: those with a score above a threshold (gamma of Sec. 3.4).

        By default a Gaussian is selected if it is more similar to the target than to all negatives: the other classes for a
        class, the canonical words for any other target. The score is then LERF's relevancy, gamma 0.5.

        Args:
            target: the name of a class, or an embedding [D].
            classes: to look up the name and for the negatives; None: the field's own.
            threshold: gamma. None: 0.5 for a relevancy, else derived from the scores; `how` of the result explains it.
            negatives: "classes", "canonical" (words of the classes' table), "none", rows [M, D], or "auto" as above.
            score: "relevancy" or "cosine". None: relevancy if there are negatives.
        """
        if score == "cosine" and isinstance(negatives, str) and negatives == "auto":
            negatives = "none"
        classes = self.classes if classes is None else classes
        cosines = self.cosines(make_question(target, classes, negatives, self.dim, self.info))
        against = cosines[:, 1:] if cosines.shape[1] > 1 else None
        return select_by_similarity(cosines[:, 0], against, threshold, self.known, score)

    def instances(self, name: str, cameras: Sequence[Camera] | None = None) -> list[Part]:
        """The things of a class ("the five chairs"), told apart by views, the field's by default (`labels.number_instances`)."""
        cameras = cameras or self.cameras
        return connected_parts(number_instances(self, cameras), self.query(name), cameras)

    def segment(self, camera: Cameras | str, classes: Classes | None = None) -> Tensor:  # [H, W] int64
        """The class of each pixel from a viewpoint, -1 for empty pixels, by the decoder's rule; of several cameras [B, H, W]."""
        if not isinstance(camera, Camera | str):
            return torch.stack([self.segment(view, classes) for view in as_cameras(camera, "pass one", one_size=True)])
        return self.rank(camera, classes, early=True).labels[..., 0]

    def rank(
        self, camera: Camera | str, classes: Classes | None = None, *, top: int = 1, early: bool = False
    ) -> Ranked:
        """The `top` best classes of each pixel by the rule of `segment`, and their scores.

        Args:
            camera: the viewpoint, as for `render`.
            classes: as for `classify`.
            top: how many, from 1 to the number of classes.
            early: for labels alone, in less time; scores and opacities are then as far as they were needed.

        Returns:
            Labels and scores [H, W, top], the best first; -1 and 0 where there is no class. And the opacity [H, W]. Scores are
            blended votes, from 0 to 1; of a field with codewords, cosines of the pixel's codeword with the classes; where
            features are compared, numbers that only compare the classes of one pixel.
        """
        rows = self._rows(classes)
        check_whole("top", top, 1, len(rows))
        with torch.no_grad():
            votes = self._votes(rows)
            if votes is not None:
                return rank_votes(self.gaussians, view_named(self.cameras, camera, "camera"), votes, top, early=early)
            rendering = self.render(camera)
            unit = unit_embeddings(rows).to(self.latents)
            labels = self.decoder.label_pixels(rendering.map, unit, top, rendering.alpha > 0)
            return Ranked(*labels, rendering.alpha)

    # Size and files

    def storage(self) -> int:
        """Bytes as in Table 1: every attribute of the Gaussians, and their decoder, in float32.

        Without an autoencoder, the table counts no codebook; here it counts, because labelling needs it. `fused` does not.
        """
        return semantic_storage_bytes(len(self), self.latents.shape[1], 0, self.decoder.parameters)

    def save(self, path: str | Path, precision: Precision | None = None) -> None:
        """Write one file, whole or not at all; an older field is replaced.

        Args:
            path: of the file; its name ends in `.kfgs`.
            precision: None keeps every bit. "fine", "small", "tiny" or your own `Rounding` pack it: Gaussians are sorted, and
                their errors noted in `info["rounded"]`.

        Raises:
            FileExistsError: if there is something other than a field at `path`.
            ValueError: if `info` is not JSON, the name ends otherwise, or (packed) a number cannot be rounded.
        """
        save_field(path, vars(self), precision)

    @classmethod
    def load(cls, path: str | Path) -> SemanticField:
        """Read what `save` wrote; of a folder, its `field.kfgs`.

        Raises:
            FileNotFoundError: if there is nothing.
            ValueError: if it is not a field, or damaged.
        """
        return load_field(path, cls)  # type: ignore[no-any-return]

    def _rows(self, classes: Classes | None) -> Tensor:  # [C, D]
        classes = self.classes if classes is None else classes
        if classes is None:
            raise ValueError("classes: expected a label set, got none, and the field holds none; pass the classes")
        return class_rows(classes, self.dim, self.info)

    def _votes(self, rows: Tensor) -> Votes | None:
        """What the Gaussians say about some classes; that for the last text is kept."""
        latents = self.latents
        version = None if latents.is_inference() else latents._version  # changed in place: votes are counted again
        kept = _VOTES.get(self)
        if kept is not None and version is not None and kept[0] == version and torch.equal(kept[1], rows.to(kept[1])):
            return kept[2]
        votes = self.decoder.votes(latents, unit_embeddings(rows).to(latents))
        if votes is not None:
            _VOTES[self] = version, rows.detach().clone(), votes
        return votes
