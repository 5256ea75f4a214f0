"""Search all fields below a folder through an index of them. A class by its name needs no torch, so that it is quick."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .._files import as_path
from .._names import class_index
from .search_file import NAME, Array, Contents, Entry, Rows, read_index

if TYPE_CHECKING:
    from torch import Tensor

    from ..labels import LabelSet, Score
    from ..labels.questions import Negatives

# Torch is imported inside the methods that need it.


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


@dataclass(frozen=True, eq=False)
class SearchIndex:
    """An index of all fields below a folder, in one file there (`search.kfgs`).

    Every Gaussian is known by its word in a `SharedCodebook`, one for each teacher. The index holds where the words are in
    each field, and each field's answers about its own classes. `update` extends it when fields are new or have changed.

    Example, with fields of `kfgs fit` below the folder runs:

        index = SearchIndex.open("runs")
        index = index.update(progress=True)
        for scene in index.search("chair").scenes:
            print(scene.path, scene.count, scene.parts[0].center, scene.parts[0].view)
    """

    folder: Path
    contents: Contents

    @classmethod
    def open(cls, folder: str | Path) -> SearchIndex:
        """Read the index of a folder; an empty one if there is none yet.

        Raises:
            NotADirectoryError: if there is no such folder.
            ValueError: if the file is damaged, or of another version.
        """
        folder = as_path(folder)
        if not folder.is_dir():
            raise NotADirectoryError(f"folder: expected a folder with runs or fields in it, got {folder}; name another")
        return cls(folder, read_index(folder / NAME) if (folder / NAME).is_file() else Contents())

    @property
    def file(self) -> Path:
        """Where the index is kept."""
        return self.folder / NAME

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields that it knows: paths relative to the folder."""
        return tuple(self.contents.entries)

    def __len__(self) -> int:
        return len(self.contents.entries)

    def __repr__(self) -> str:
        return f"SearchIndex({self.folder}: {len(self)} fields, {sum(len(one.words) for one in self.contents.spaces)} words)"

    def is_current(self) -> bool:
        """Whether the fields below the folder are those of the index, unchanged (by size and time, then by digest)."""
        from .search_state import compare_fields

        state = compare_fields(self.folder, self.contents)
        return not (state.changed or state.removed)

    def update(self, *, progress: bool = False, report: Callable[[str], None] | None = None) -> tuple[SearchIndex, Changes]:
        """Add fields that are new or have changed, drop those that are gone, and write the file if anything changed.

        Words keep their ids. The file is replaced in one step, some times a minute in a long update, so a killed one loses
        little. A field that cannot be read is left out and said.

        Args:
            progress: show a bar.
            report: called with a line for each field that is left out.

        Returns:
            The index as it is now, and what changed.

        Raises:
            ValueError: if another process updates it, or the file was damaged.
            OSError: if the folder cannot be written to.
        """
        from .search_update import update_index

        contents, changes = update_index(self.folder, progress=progress, report=report)
        return SearchIndex(self.folder, contents), changes

    def search(
        self,
        target: str | Tensor,
        classes: LabelSet | None = None,
        threshold: float | None = None,
        *,
        negatives: Negatives | Tensor = "auto",
        score: Score | None = None,
        exact: int = 0,
    ) -> Found:
        """Find a class or an embedding in all fields. The arguments are those of `SemanticField.query`.

        A class of a field's own table, with all other arguments at their defaults, has the exact answer: that of
        `field.query(name)` when the field was indexed. All other questions are put to the words instead of the Gaussians.

        Args:
            target: the name of a class, or an embedding [D].
            classes: to look up the name and for the negatives. None: the own classes of each field; for a name that they
                lack, those of the first field of the same teacher that has it.
            threshold: gamma, the score to exceed. None: as `query` does.
            negatives: as in `query`.
            score: as in `query`.
            exact: ask the fields themselves for this many of the best scenes (each is loaded), and rank again.

        Raises:
            ValueError: if no field knows the class, no field has as many channels as the embedding, or an option is wrong.
        """
        plain = isinstance(target, str) and classes is None and threshold is None and score is None
        found, unasked, others = [], dict[str, str](), []
        for entry in self.contents.entries.values():
            label = self._label(entry, target) if plain and isinstance(target, str) and negatives == "auto" else None
            if label is None:
                others.append(entry)
            else:
                found.append(_class_answer(entry, label))
        if others:
            from .search_words import ask_words

            options = {"threshold": threshold, "negatives": negatives, "score": score}
            more, unasked = ask_words(self.contents, others, target, classes, options)
            found += more
            if exact:
                from .search_words import ask_fields

                found = ask_fields(self.folder, self.contents, ranked(found), exact, target, classes, options)
        return Found(ranked(found), len(self) - len(unasked), unasked)

    def _label(self, entry: Entry, name: str) -> int | None:
        """The label of a class in the field's own table, if the index holds the answers about it."""
        if entry.table is None or not len(entry.rows["classes"]["count"]):
            return None
        try:
            return class_index(name, self.contents.tables[entry.table].names)
        except ValueError:
            return None


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
    corners = (tuple(map(float, rows[name][i])) for name in ("center", "low", "high"))
    name = entry.views[view] if view >= 0 else None
    return PartFound(int(rows["count"][i]), float(rows["score"][i]), *corners, name, float(share) if view >= 0 else 0.0)


def _class_answer(entry: Entry, label: int) -> SceneFound:
    """The answer that the index holds about a class."""
    rows, totals = entry.rows["parts"], entry.rows["classes"]
    mine: Array = np.flatnonzero(rows["label"] == label)
    parts = (part_found(entry, rows, i, int(rows["view"][i]), float(rows["share"][i])) for i in mine.tolist())
    return scene_found(entry, int(totals["count"][label]), float(totals["score"][label]), True, parts)
