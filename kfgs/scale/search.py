"""Search all fields below a folder through an index of them. A class by its name needs no torch, so that it is quick."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .._files import as_path
from .._names import class_index
from .search_file import NAME, Array, Contents, Entry, read_index
from .search_found import Changes, Found, SceneFound, part_found, ranked, scene_found

if TYPE_CHECKING:
    from torch import Tensor

    from ..labels import LabelSet, Score
    from ..labels.questions import Negatives

# Torch is imported inside the methods that need it.


@dataclass(frozen=True, eq=False)
class SearchIndex:
    """An index of all fields below a folder, in one file there (`search.kfgs`).

    Every Gaussian is known by its word in a `SharedCodebook`, one for each teacher. The index holds where the words are in
    each field, and each field's answers about its own classes. `update` extends it when fields are new or have changed.

    Example, with fields of `kfgs fit` below the folder runs::

        index = SearchIndex.open("runs")
        index, changes = index.update(progress=True)
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
            ValueError: if the file is damaged, or of another version, or no file.
        """
        folder = as_path(folder)
        if not folder.is_dir():
            raise NotADirectoryError(f"folder: expected a folder with runs or fields in it, got {folder}; name another")
        return cls(folder, read_index(folder / NAME))

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
        """Whether the fields below the folder are those of the index, with the same sizes and times.

        If not, `update` reads what differs, by digest; a copied or touched field is the same, and gets its new time.
        """
        from .search_state import is_current

        return is_current(self.folder, self.contents)

    def update(
        self, *, progress: bool = False, report: Callable[[str], None] | None = None
    ) -> tuple[SearchIndex, Changes]:
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
        found, others = list[SceneFound](), list[Entry]()
        unasked = {name: one.reason for name, one in self.contents.unread.items()}
        for entry in self.contents.entries.values():
            label = self._label(entry, target) if plain and isinstance(target, str) and negatives == "auto" else None
            if label is None:
                others.append(entry)
            else:
                found.append(_class_answer(entry, label))
        if others:
            from .search_words import ask_fields, ask_words

            options = {"threshold": threshold, "negatives": negatives, "score": score}
            more, refused = ask_words(self.contents, others, target, classes, options)
            found, unasked = found + more, unasked | refused
            if exact:
                found, lost = ask_fields(self.folder, self.contents, ranked(found), exact, target, classes, options)
                return Found(ranked(found), len(self) + len(self.contents.unread) - len(unasked), unasked | lost)
        return Found(ranked(found), len(self) + len(self.contents.unread) - len(unasked), unasked)

    def like(self, source: str | Path, index: int, threshold: float | None = None, *, exact: int = 0) -> Found:
        """Find what resembles one Gaussian of a field: by the cosine of features, without text.

        Args:
            source: the field of the example, in the index or not.
            index: of the Gaussian, from 0.
            threshold: the cosine to exceed; None: the tolerance of the words, 0.9.
            exact: as in `search`.

        Raises:
            ValueError: if there is no such Gaussian, no view shows it, or no field in the index is of its teacher.
        """
        from .search_words import example_of

        row, mine, tolerance = example_of(self.contents, as_path(source), index)
        contents = Contents(self.contents.spaces, self.contents.tables, mine, self.contents.unread)
        gamma = tolerance if threshold is None else threshold
        found = SearchIndex(self.folder, contents).search(row, None, gamma, negatives="none", exact=exact)
        others = {name: "another teacher" for name in self.fields if name not in mine}
        return Found(found.scenes, found.searched, found.unasked | others)

    def _label(self, entry: Entry, name: str) -> int | None:
        """The label of a class in the field's own table, if the index holds the answers about it."""
        if entry.table is None or not len(entry.rows["classes"]["count"]):
            return None
        try:
            return class_index(name, self.contents.tables[entry.table].names)
        except ValueError:
            return None


def _class_answer(entry: Entry, label: int) -> SceneFound:
    """The answer that the index holds about a class."""
    rows, totals = entry.rows["parts"], entry.rows["classes"]
    mine: Array = np.flatnonzero(rows["label"] == label)
    parts = (part_found(entry, rows, i, int(rows["view"][i]), float(rows["share"][i])) for i in mine.tolist())
    return scene_found(entry, int(totals["count"][label]), float(totals["score"][label]), True, parts)
