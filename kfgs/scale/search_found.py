"""The answer of a search over many fields: scenes, and the parts found in each."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from .search_file import Entry, Rows


@dataclass(frozen=True)
class PartFound:
    """A connected part of what was found in a scene ("one of the chairs"). Positions are in the scene's frame and units."""

    count: int
    """Gaussians."""
    score: float
    """Their mean score."""
    center: tuple[float, ...]  # [3] mean of their centres
    low: tuple[float, ...]  # [3] lowest corner of the box around their centres, along the world's axes
    high: tuple[float, ...]  # [3] highest corner
    view: str | None
    """Name of the training view that shows it largest; None if the field has no views, or none shows it."""
    share: float
    """Its share of that picture, in [0, 1)."""


@dataclass(frozen=True)
class SceneFound:
    """What was found in one field."""

    path: str
    """Of the field, relative to the folder that was searched."""
    count: int
    """Gaussians found, those of small parts included."""
    gaussians: int
    """Of the whole field."""
    score: float
    """The highest mean score among its parts; scenes are ranked by it."""
    exact: bool
    """Whether count, parts and scores are those of `SemanticField.query` and `connected_parts`; else words stand for
    Gaussians."""
    parts: tuple[PartFound, ...]
    """The largest first; those below 5 % of the largest are left out."""


@dataclass(frozen=True)
class Found:
    """The answer of a search."""

    scenes: tuple[SceneFound, ...]
    """The best first."""
    searched: int
    """Fields that could be asked."""
    unasked: dict[str, str] = field(default_factory=dict)
    """Fields that could not be asked, and why."""

    def to_json(self) -> dict[str, Any]:
        """Plain numbers, lists and strings."""
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class Changes:
    """What an update of an index did; paths are relative to its folder."""

    added: tuple[str, ...] = ()
    """New fields, and changed ones."""
    removed: tuple[str, ...] = ()
    failed: dict[str, str] = field(default_factory=dict)
    """Fields that could not be read, and why."""


def ranked(found: list[SceneFound]) -> tuple[SceneFound, ...]:
    """Scenes in which something was found, the best first; equally good ones by count, then by name."""
    return tuple(sorted((one for one in found if one.count), key=lambda one: (-one.score, -one.count, one.path)))


def scene_found(entry: Entry, count: int, score: float, exact: bool, parts: Iterator[PartFound]) -> SceneFound:
    """A scene with its parts; without parts its score is `score`."""
    kept = tuple(parts)
    best = max((part.score for part in kept), default=score)
    return SceneFound(entry.path, count, entry.gaussians, best, exact, kept)


def part_found(entry: Entry, rows: Rows, i: int, view: int, share: float) -> PartFound:
    """Row i of some columns as a part."""
    places = (rows[name][i] for name in ("center", "low", "high"))
    center, low, high = (tuple(float(x) + o for x, o in zip(place, entry.origin, strict=True)) for place in places)
    shown = (entry.views[view], float(share)) if view >= 0 else (None, 0.0)
    return PartFound(int(rows["count"][i]), float(rows["score"][i]), center, low, high, *shown)
