"""Whatever can be scored: kfgs's field, a baseline, a checkpoint of another program, or the teacher itself."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from .._rows import EPS, row_norms, unit_embeddings, unit_rows
from ..cameras import Camera
from ..fields import SemanticField
from ..gaussians import Gaussians
from ..scenes import FeatureFolder

CHUNK = 8192  # pixels decoded at once


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
    codeword with the nearest latent. Classes of pixels are those of `SemanticField.segment`, unless `own_labels` is False.

    Args:
        field: any field.
        name: for tables; None: "kfgs" and the name of the field's decoder.
        own_labels: False takes the class with the largest cosine, as for the other methods.
    """

    levels = 1

    def __init__(self, field: SemanticField, name: str | None = None, *, own_labels: bool = True) -> None:
        self.field = field
        self.name = f"kfgs {field.decoder.name}" if name is None else name
        self.own_labels = own_labels

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
        """The class of each pixel: what `SemanticField.segment` says, or the largest cosine."""
        return self.field.segment(view.camera, text) if self.own_labels else best_labels(self.cosines(view, text)[0])

    def gaussian_cosines(self, text: Tensor) -> Tensor:  # [K, D] -> [1, N, K]
        """The cosine of each Gaussian's fused feature with each text (`SemanticField.cosines`)."""
        return self.field.cosines(text).masked_fill(~self.field.known[:, None], torch.nan)[None]


class TeacherMethod:
    """A teacher's maps as a method: one level and no Gaussians. Scores of it are what a field of these maps can reach.

    A map of another size than the picture is resized bilinearly, a few rows at a time, before cosines are taken.

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
        height, width = view.camera.size
        upper, lower, down = _taps(height, int(features.shape[0]), self.align_corners)
        left, right, across = _taps(width, int(features.shape[1]), self.align_corners)
        down, across = down.to(unit)[:, None, None], across.to(unit)[:, None]
        cosines = torch.empty(height, width, len(unit)).to(unit)
        rows = max(1, CHUNK // width)
        for start in range(0, height, rows):
            part = slice(start, start + rows)
            band = torch.lerp(features[upper[part]].to(wide), features[lower[part]].to(wide), down[part])
            band = torch.lerp(band[:, left], band[:, right], across)
            unknown = row_norms(band) <= EPS
            cosines[part] = (unit_rows(band) @ unit.T).masked_fill(unknown[..., None], torch.nan)
        return cosines[None]

    def gaussian_cosines(self, text: Tensor) -> Tensor:
        """Raise a TypeError: a teacher has no Gaussians."""
        raise TypeError(f"method: expected one with Gaussians, got the teacher {self.name!r}; use a protocol of views")


def _taps(size: int, source: int, align_corners: bool) -> tuple[Tensor, Tensor, Tensor]:
    """For each of `size` places the two of `source` that are blended, and the share of the second."""
    places = torch.arange(size, dtype=torch.float64)
    if align_corners:
        places = places * ((source - 1) / max(size - 1, 1))
    else:
        places = ((places + 0.5) * (source / size) - 0.5).clamp_min(0)
    first = places.floor().long().clamp_max(source - 1)
    return first, (first + 1).clamp_max(source - 1), places - first
