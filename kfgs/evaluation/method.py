"""Whatever can be scored: kfgs's field, a baseline, a checkpoint of another program, or the teacher itself."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Literal, NamedTuple, Protocol, get_args, runtime_checkable

import torch
from torch import Tensor

from .._check import check_choice, check_shapes
from .._rows import EPS, unit_embeddings
from ..cameras import Camera, resize_map
from ..fields import SemanticField
from ..gaussians import Gaussians
from ..scenes import FeatureFolder

LabelRule = Literal["own", "nearest", "paper"]
CHANNELS = 64  # of a teacher's map, enlarged at once


class View(NamedTuple):
    """One picture of a scene."""

    stem: str
    """The picture's name without its ending."""
    camera: Camera
    """Without distortion; its size is that of the picture that is scored."""


@runtime_checkable
class Method(Protocol):
    """What a protocol needs of a method: cosines with texts, for pixels and for Gaussians, in the teacher's text space."""

    @property
    def name(self) -> str:
        """For tables: "LangSplat"."""

    @property
    def levels(self) -> int:
        """How many maps it has of a view: 1, or 3 for LangSplat (small, medium and large parts)."""

    @property
    def gaussians(self) -> Gaussians | None:
        """Its geometry; None for a teacher."""

    def cosines(self, view: View, text: Tensor) -> Tensor:  # [K, D] unit rows -> [levels, H, W, K]
        """The cosine of each pixel's feature with each text; NaN where nothing is known."""

    def gaussian_cosines(self, text: Tensor) -> Tensor:  # [K, D] unit rows -> [levels, N, K]
        """The cosine of each Gaussian's feature with each text; NaN rows for Gaussians without a feature."""


@runtime_checkable
class Labeller(Protocol):
    """A method that decides the classes of pixels itself. Without `labels`, a pixel takes the class with the largest cosine."""

    def labels(self, view: View, text: Tensor) -> Tensor:  # [K, D] unit rows -> [H, W] int64
        """The class of each pixel, -1 where nothing is known."""


def best_labels(cosines: Tensor) -> Tensor:  # [..., K] -> [...] int64
    """The text with the largest cosine; -1 where the cosines are NaN. A tie goes to the lowest.

    Example:
        >>> best_labels(torch.tensor([[0.1, 0.3], [0.2, 0.2], [float("nan")] * 2])).tolist()
        [1, 0, -1]
    """
    if cosines.ndim == 0 or cosines.shape[-1] == 0:
        raise ValueError(f"cosines: expected [..., C] with at least one class, got {tuple(cosines.shape)}")
    unknown = cosines.isnan()
    return cosines.masked_fill(unknown, -torch.inf).argmax(-1).masked_fill(unknown.all(-1), -1)


def check_level(method: Method, level: int | str) -> None:
    """Raise a ValueError unless the method has a map of that level, or `level` is the name of a rule."""
    if not isinstance(level, str) and not 0 <= level < method.levels:
        raise ValueError(
            f"level: expected 0 to {method.levels - 1} (the levels of {method.name!r}), got {level}; choose one of them"
        )


def label_view(method: Method, view: View, text: Tensor, level: int = 0) -> Tensor:  # [H, W] int64
    """The class of each pixel: the method's own answer if it has one (`Labeller`), else the class with the largest cosine.

    Args:
        method: what is scored.
        view: the picture.
        text: one unit row per class, [K, D].
        level: the map of a method with several.
    """
    check_level(method, level)
    if isinstance(method, Labeller):
        return method.labels(view, text)
    return best_labels(method.cosines(view, text)[level])


def annotated(views: Sequence[View], stems: Iterable[str]) -> list[View]:
    """The views that have ground truth, in their order; a ValueError if a picture with ground truth has no view."""
    wanted = set(stems)
    scored = [view for view in views if view.stem in wanted]
    missing = sorted(wanted - {view.stem for view in scored})
    if missing or not scored:
        raise ValueError(
            f"views: expected one for each of {len(wanted)} pictures with ground truth, got none for "
            f"{', '.join(missing[:3]) or 'any'}{' ...' if len(missing) > 3 else ''}; pass views with these stems"
        )
    return scored


class FieldMethod:
    """A `SemanticField` as a method: one level.

    The cosine of a pixel is that of the feature that is rendered there; of a field with an autoencoder, that of the
    codeword with the nearest latent.

    Args:
        field: any field.
        name: for tables; None: "kfgs" and the name of the field's decoder.
        rule: how a pixel gets its class. own: `SemanticField.segment`; paper: Sec. 3.4 as printed, `field.paper.segment` (decode,
            quantise to S, look up the codeword's class); nearest: the text with the largest cosine, as for other methods.
    """

    levels = 1

    def __init__(self, field: SemanticField, name: str | None = None, *, rule: LabelRule = "own") -> None:
        check_choice("rule", rule, get_args(LabelRule))
        self.field, self.rule = field, rule
        self._asked = field.paper if rule == "paper" else field
        self.name = f"kfgs {field.decoder.name}" if name is None else name

    @property
    def gaussians(self) -> Gaussians:
        """The field's Gaussians."""
        return self.field.gaussians

    def cosines(self, view: View, text: Tensor) -> Tensor:  # [K, D] -> [1, H, W, K]
        """The cosine of each pixel's rendered feature with each text; NaN where nothing was drawn."""
        field = self.field
        unit = unit_embeddings(text, "text").to(field.latents)
        with torch.no_grad():
            rendering = field.render(view.camera)
            labels, scores = field.decoder.label_pixels(rendering.map, unit, len(unit), rendering.alpha > 0)
            unknown = torch.full_like(scores, torch.nan)
            return torch.where(labels < 0, unknown, unknown.scatter(2, labels.clamp_min(0), scores))[None]

    def labels(self, view: View, text: Tensor) -> Tensor:  # [K, D] -> [H, W] int64
        """The class of each pixel by the method's rule."""
        if self.rule == "nearest":
            return best_labels(self.cosines(view, text)[0])
        return self._asked.segment(view.camera, text)

    def gaussian_cosines(self, text: Tensor) -> Tensor:  # [K, D] -> [1, N, K]
        """The cosine of each Gaussian's fused feature with each text (`SemanticField.cosines`)."""
        return self.field.cosines(text).masked_fill(~self.field.known[:, None], torch.nan)[None]


class TeacherMethod:
    """A teacher's maps as a method: one level and no Gaussians. Scores of it are what a field of these maps can reach.

    A map of another size than the picture is resized bilinearly, a few channels at a time, before cosines are taken.

    Args:
        maps: a `FeatureFolder`, or maps [h, w, D] by the stem of their picture. An all-zero feature means "unknown".
        name: for tables.
        align_corners: False resizes maps as `resize_map` does; True puts corner pixels on each other, as Feature 3DGS does.
    """

    levels = 1
    gaussians: Gaussians | None = None

    def __init__(
        self, maps: FeatureFolder | Mapping[str, Tensor], name: str = "teacher", *, align_corners: bool = False
    ) -> None:
        self.maps, self.name, self.align_corners = maps, name, align_corners

    def cosines(self, view: View, text: Tensor) -> Tensor:  # [K, D] -> [1, H, W, K]
        """The cosine of each pixel's feature with each text, NaN where the map says nothing; a KeyError without a map."""
        maps, stem = self.maps, view.stem
        if stem not in (maps.stems if isinstance(maps, FeatureFolder) else maps):
            raise KeyError(f"view: expected a picture that has a map, got {stem!r}; choose views of the maps' folder")
        features = maps[maps.stems.index(stem)] if isinstance(maps, FeatureFolder) else maps[stem]
        wide = torch.promote_types(features.dtype, torch.float32)  # half precision is computed in float32
        unit = unit_embeddings(text, "text").to(features.device, wide)
        check_shapes((f"the map of {stem!r}", features, ("h", "w", unit.shape[1])))
        products = unit.new_zeros(*view.camera.size, len(unit))
        squares = unit.new_zeros(*view.camera.size, 1)
        for some, rows in zip(features.split(CHANNELS, dim=2), unit.split(CHANNELS, dim=1), strict=True):
            band = resize_map(some.to(wide), view.camera.size, align_corners=self.align_corners)
            products += band @ rows.T
            squares += band.square().sum(dim=2, keepdim=True)
        lengths = squares.sqrt()
        return (products / lengths.clamp_min(EPS)).masked_fill(lengths <= EPS, torch.nan)[None]

    def gaussian_cosines(self, text: Tensor) -> Tensor:
        """Raise a TypeError: a teacher has no Gaussians."""
        raise TypeError(f"method: expected one with Gaussians, got the teacher {self.name!r}; use a protocol of views")
