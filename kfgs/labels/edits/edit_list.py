"""Edits in order: applied together, undone one by one, saved as JSON and replayed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..._card import cut
from ..._files import as_path, read_json, write_json
from ...gaussians import Gaussians
from ..where import read_object
from .edit import Edit, Extract, Opacity, Recolor, Remove
from .insert import Insert
from .motion import Duplicate, Move

FORMAT, VERSION = "kfgs.edits", 1
OPS: dict[str, type[Edit]] = {op.op: op for op in (Remove, Extract, Recolor, Opacity, Move, Duplicate, Insert)}


def edits_path(path: str | Path) -> Path:
    """`scene.ply` -> `scene.ply.edits.json`: the edits that made this one splat file."""
    path = as_path(path)
    return path.with_name(path.name + ".edits.json")


class EditError(ValueError):
    """An edit of a list that cannot be done: its place in the list, and why."""

    def __init__(self, index: int, edit: Edit, why: ValueError) -> None:
        super().__init__(f"edits[{index}] ({edit.op}): {why}")
        self.index, self.why = index, why


@dataclass(frozen=True)
class EditList:
    """Edits that are applied one after the other, each to the result of the one before.

    Nothing is changed in place: `then`, `undo` and `redo` give new lists, `apply` a new cloud.

    Example:
        >>> edits = EditList().then(Recolor("plant", "#c04040")).then(Remove("chair"))
        >>> len(edits), len(edits.undo()), edits.undo().redo() == edits
        (2, 1, True)
    """

    edits: tuple[Edit, ...] = ()
    """The edits that `apply` applies, in order."""
    undone: tuple[Edit, ...] = ()
    """The edits that `redo` restores, the last one first."""

    def __post_init__(self) -> None:
        for name in ("edits", "undone"):
            edits = getattr(self, name)
            if not isinstance(edits, list | tuple) or not all(isinstance(edit, Edit) for edit in edits):
                raise TypeError(f"{name}: expected a list of edits, got {edits!r:.80}; write it as [Remove('chair')]")
            object.__setattr__(self, name, tuple(edits))

    def __repr__(self) -> str:
        undone = f"; {len(self.undone)} undone" if self.undone else ""
        edits = ", ".join(map(repr, self.edits[:9])) + (", ..." if len(self) > 9 else "")
        return f"EditList({len(self)} edits{': ' + cut(edits, 140) if edits else ''}{undone})"

    def __len__(self) -> int:
        return len(self.edits)

    def __iter__(self) -> Iterator[Edit]:
        return iter(self.edits)

    def then(self, edit: Edit) -> EditList:
        """The list with one more edit, and without undone edits."""
        return EditList((*self.edits, edit))

    def undo(self) -> EditList:
        """The list without its last edit; `redo` restores it. A ValueError if there is none."""
        if not self.edits:
            raise ValueError("edits: expected an edit to undo, got an empty list; add one with then()")
        return EditList(self.edits[:-1], (*self.undone, self.edits[-1]))

    def redo(self) -> EditList:
        """The list with the edit that was undone last; a ValueError if nothing was undone since the last `then`."""
        if not self.undone:
            raise ValueError("undone: expected an edit to redo, got none; undo() one first, and then() forgets them")
        return EditList((*self.edits, self.undone[-1]), self.undone[:-1])

    def apply(self, gaussians: Gaussians) -> Gaussians:
        """The cloud after all edits.

        Raises:
            EditError: if an edit cannot be done; the message says which.
            FileNotFoundError: if a file to insert is missing.
        """
        for i, edit in enumerate(self.edits):
            try:
                gaussians = edit.apply(gaussians)
            except ValueError as error:
                raise EditError(i, edit, error) from error
        return gaussians

    def save(self, path: str | Path) -> Path:
        """Write the list as JSON, without undone edits.

        Files to insert that lie in the folder of the JSON file or below are named relative to it. Others are named in full,
        and `load` reads them only with `anywhere=True`. A ValueError if an insert holds a cloud in memory.
        """
        path = as_path(path)
        edits = [edit.seen_from(path.parent) if isinstance(edit, Insert) else edit for edit in self.edits]
        write_json(path, {"format": FORMAT, "version": VERSION, "edits": [edit.to_json() for edit in edits]})
        return path

    @staticmethod
    def load(path: str | Path, *, anywhere: bool = False) -> EditList:
        """Read what `save` wrote.

        Args:
            path: the JSON file. Paths of files to insert are relative to its folder.
            anywhere: also allow files to insert from outside this folder.

        Raises:
            FileNotFoundError: if there is no such file, or a file to insert is missing.
            ValueError: if it is another kind of file, or an edit in it is unknown or wrong; the message names its place.
        """
        path = as_path(path)
        content = read_json(path)
        if not isinstance(content, dict) or content.get("format") != FORMAT or content.get("version") != VERSION:
            raise ValueError(
                f"{path}: expected edits that kfgs saved ('format': {FORMAT!r}, 'version': {VERSION}), got something else"
            )
        name = f"{path}: edits"
        edits = [
            edit.found_in(path.parent, f"{name}[{i}]", anywhere=anywhere) if isinstance(edit, Insert) else edit
            for i, edit in enumerate(read_edits(content.get("edits"), name))
        ]
        return EditList(tuple(edits))


def read_edits(values: Any, name: str = "edits") -> tuple[Edit, ...]:
    """Edits from plain values (`Edit.to_json`) that anyone may have written; a ValueError begins with their place, `name`."""
    if not isinstance(values, list):
        raise ValueError(f"{name}: expected a list of edits, got {values!r:.80}; write it as [...]")
    return tuple(read_object(f"{name}[{i}]", value, OPS, "op") for i, value in enumerate(values))
