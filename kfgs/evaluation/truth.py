"""Ground truth of a scene: classes of pixels, and classes of points on its surfaces."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor

from .._card import short_repr
from .._check import ORIGIN, check_choice, check_shapes
from .._origin import choose_origin

T = TypeVar("T")
Merged = tuple[tuple[str, str], ...]
"""Pairs of names: in truth and answers, the first class counts as the second. All names are asked."""
VOID_NAMES = ("void", "unlabeled", "unlabelled", "unknown", "ignore")
"""Names that mean "no class". Their pixels and points are not scored."""


@dataclass(frozen=True, eq=False)
class LabelTruth:
    """A closed set of classes, and the class of each pixel."""

    names: tuple[str, ...]
    """The classes; a label is an index into them."""
    maps: Mapping[str, Path | Tensor]
    """Labels [H, W] int64, -1 = void, by the picture's stem; or a label picture that `load_label_map` reads."""

    __repr__ = short_repr


def in_world(points: Tensor) -> Tensor:  # [N, 3] float64
    """Places that stay in the world: in float32, or as they are if that would lose something."""
    return points.float() if choose_origin(points) == ORIGIN else points


@dataclass(frozen=True, eq=False)
class PointTruth:
    """Labelled points on the surfaces of a scene."""

    points: Tensor  # [P, 3] world units
    labels: Tensor  # [P] int64: the data set's own ids
    names: Mapping[int, str]
    """The names of ids. A label that is not in here is unlabelled: 0 in ScanNet, -1 elsewhere."""
    instances: Tensor | None = None  # [P] int64, -1 = none

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_shapes(("points", self.points, "P 3"), ("labels", self.labels, "P"), ("instances", self.instances, "P"))


class ReadWhenAsked(Mapping[str, T]):
    """Values by name that are read from disk when they are asked for. Only the last one stays in memory."""

    def __init__(self, readers: Mapping[str, Callable[[], T]]) -> None:
        self._readers = dict(readers)
        self._last: tuple[str, T] | None = None

    def __getitem__(self, key: str) -> T:
        last = self._last  # read once: another thread may change it
        if last is None or last[0] != key:
            last = self._last = (key, self._readers[key]())
        return last[1]

    def __iter__(self) -> Iterator[str]:
        return iter(self._readers)

    def __len__(self) -> int:
        return len(self._readers)


def merge_table(names: Sequence[str], merged: Merged) -> Tensor:  # [C + 1] int64
    """The class that each class counts as, itself by default; -1 at the end. Names by `name_key`, chains are followed.

    A ValueError for what is not a pair of classes, and for pairs that go round in a circle.
    """
    keys, table, becomes = [name_key(name) for name in names], [*range(len(names)), -1], dict[str, int]()
    for pair in merged:
        if not isinstance(pair, tuple | list) or [type(name) for name in pair] != [str, str]:
            raise ValueError(f"merged: expected pairs of names, got {pair!r:.80}; for instance (('rug', 'floor'),)")
        for name in pair:
            if name_key(name) not in keys:
                check_choice("merged", name, names)
        becomes[name_key(pair[0])] = keys.index(name_key(pair[1]))
    for _ in becomes:
        table = [becomes.get(keys[i], i) if i >= 0 else i for i in table]
    if any(keys[i] in becomes for i in table[:-1]):
        raise ValueError(f"merged: expected pairs (class, what it counts as) without a circle, got {merged}")
    return torch.tensor(table)


def name_key(name: str) -> str:
    """The form in which class names are compared: "Shower-Curtain" is "showercurtain"."""
    return name.casefold().translate(str.maketrans("", "", " -_"))


def is_void(name: str) -> bool:
    """Whether a name means "no class"."""
    return name_key(name) in VOID_NAMES
