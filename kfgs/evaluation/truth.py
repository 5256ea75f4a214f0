"""Ground truth of a scene, as data-set readers give it and protocols take it: nothing here reads a file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from .._card import short_repr
from .._check import check_shapes
from .._typed import typed


@typed
@dataclass(frozen=True, eq=False)
class LabelTruth:
    """A closed set of classes, and the class of each pixel."""

    names: tuple[str, ...]
    """The classes; a label is an index into them."""
    maps: Mapping[str, Path | Tensor]
    """Labels [H, W] int64, -1 = void, by the picture's stem; or a label picture that `load_label_map` reads."""

    __repr__ = short_repr

    def __post_init__(self) -> None:
        for stem, labels in self.maps.items():
            if isinstance(labels, Tensor):
                check_shapes((f"maps[{stem!r}]", labels, "H W"))
                if labels.is_floating_point():
                    raise TypeError(f"maps[{stem!r}]: expected whole numbers, got {labels.dtype}; convert with .long()")


class MaskAndBoxes(NamedTuple):
    """Where one text is in a picture."""

    mask: Tensor  # [H, W] bool
    boxes: Tensor | None = None  # [B, 4] x1, y1, x2, y2 in pixels, one for each object

    def __repr__(self) -> str:
        return short_repr(self)


@typed
@dataclass(frozen=True, eq=False)
class MaskTruth:
    """Masks of texts in some pictures; those of one picture may overlap, and leave pixels without any."""

    frames: Mapping[str, Mapping[str, MaskAndBoxes]]
    """By the picture's stem, then by text. A text that a frame lacks is not asked there."""
    scene: str | None = None
    """The data set's name of the scene ("figurines"), where a protocol has a list of texts for it."""
    listed: tuple[str, ...] = ()
    """The data set's own list of the scene's texts (`classes.txt` of 3D-OVS), whether a picture has a mask of each or not."""

    __repr__ = short_repr

    def __post_init__(self) -> None:
        for stem, texts in self.frames.items():
            sizes = []
            for text, (mask, boxes) in texts.items():
                name = f"frames[{stem!r}][{text!r}]"
                check_shapes((f"{name}.mask", mask, "H W"), (f"{name}.boxes", boxes, "B 4"))
                sizes.append((f"{name}.mask", mask, "H W"))
            check_shapes(*sizes)

    @property
    def texts(self) -> tuple[str, ...]:
        """All texts that have a mask, in the order of their first appearance."""
        return tuple(dict.fromkeys(text for texts in self.frames.values() for text in texts))


@typed
@dataclass(frozen=True, eq=False)
class PointTruth:
    """Labelled points of a scene's surfaces."""

    points: Tensor  # [P, 3] world units
    labels: Tensor  # [P] int64: the data set's own ids
    names: Mapping[int, str]
    """The names of ids. A label that is not in here is unlabelled: 0 in ScanNet, -1 elsewhere."""
    instances: Tensor | None = None  # [P] int64, -1 = none

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_shapes(("points", self.points, "P 3"), ("labels", self.labels, "P"), ("instances", self.instances, "P"))
        if self.labels.is_floating_point():
            raise TypeError(f"labels: expected whole numbers, got {self.labels.dtype}; convert with .long()")
