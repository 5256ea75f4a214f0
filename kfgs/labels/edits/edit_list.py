"""Edits in order: applied together, undone one by one, saved as JSON and replayed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..._card import cut
from ..._files import as_path, read_json, write_json
from ...formats.splat_file import SplatFile
from .._json import build, checked_object
from ..where import Where
from .edit import Edit, Extract, Opacity, Recolor, Remove
from .insert import Insert, read_similarity, read_source
from .motion import Duplicate, Move, Turn

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

    Nothing is changed in place: `then`, `undo` and `redo` give new lists, `apply` a new cloud. `Remove` after `Insert` can
    remove inserted Gaussians.

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
            given = getattr(self, name)
            if isinstance(given, Edit) or not isinstance(given, Iterable):
                raise TypeError(f"{name}: expected a list of edits, got {given!r:.80}; write it as [Remove('chair')]")
            edits = tuple(given)
            for i, edit in enumerate(edits):
                if not isinstance(edit, Edit):
                    raise TypeError(f"{name}[{i}]: expected an edit, got {edit!r:.80}; use one of {_names()}")
            object.__setattr__(self, name, edits)

    def __repr__(self) -> str:
        undone = f"; {len(self.undone)} undone" if self.undone else ""
        shown = (
            f": {cut(', '.join(map(repr, self.edits[:9])) + (', ...' if len(self) > 9 else ''), 140)}"
            if self.edits
            else ""
        )
        return f"EditList({len(self)} edits{shown}{undone})"

    def __len__(self) -> int:
        return len(self.edits)

    def __iter__(self) -> Iterator[Edit]:
        return iter(self.edits)

    def then(self, edit: Edit) -> EditList:
        """The list with one more edit, and without undone edits."""
        return EditList((*self.edits, edit))

    def undo(self) -> EditList:
        """The list without its last edit; `redo` restores it.

        Raises:
            ValueError: if there is nothing to undo.
        """
        if not self.edits:
            raise ValueError("edits: expected an edit to undo, got an empty list; add one with then()")
        return EditList(self.edits[:-1], (*self.undone, self.edits[-1]))

    def redo(self) -> EditList:
        """The list with the edit that was undone last.

        Raises:
            ValueError: if nothing was undone since the last `then`.
        """
        if not self.undone:
            raise ValueError("undone: expected an edit to redo, got none; undo() one first, and then() forgets them")
        return EditList((*self.edits, self.undone[-1]), self.undone[:-1])

    def apply(self, splats: SplatFile) -> SplatFile:
        """The cloud after all edits.

        Raises:
            EditError: if an edit cannot be done; the message says which.
            FileNotFoundError: if a file to insert is missing.
        """
        for i, edit in enumerate(self.edits):
            try:
                splats = edit.apply(splats)
            except ValueError as error:
                raise EditError(i, edit, error) from error
        return splats

    def save(self, path: str | Path) -> Path:
        """Write the list as JSON, undone edits included.

        Files to insert that lie in the folder of the JSON file or below are named relative to it. Others are named in full,
        and `load` reads them only with `anywhere=True`.

        Raises:
            ValueError: if an insert holds a cloud in memory.
        """
        path = as_path(path)
        write_json(
            path,
            {"format": FORMAT, "version": VERSION}
            | {
                name: [_written(edit, f"{name}[{i}]", path.parent) for i, edit in enumerate(edits)]
                for name, edits in (("edits", self.edits), ("undone", self.undone))
            },
        )
        return path

    @staticmethod
    def load(path: str | Path, *, anywhere: bool = False) -> EditList:
        """Read what `save` wrote.

        Args:
            path: the JSON file. Paths of files to insert are relative to its folder.
            anywhere: also allow files to insert from outside this folder.

        Raises:
            FileNotFoundError: if there is no such file, or a file to insert is missing.
            ValueError: if it is another kind of file or of another version, or an edit in it is unknown or wrong; the
                message names the place in the file.
        """
        path = as_path(path)
        return EditList.from_json(read_json(path), str(path), path.parent, anywhere=anywhere)

    @staticmethod
    def from_json(content: Any, name: str, folder: str | Path = ".", *, anywhere: bool = False) -> EditList:
        """The list from what `save` wrote, already parsed.

        Args:
            content: the JSON object.
            name: of its file or argument, for messages.
            folder: paths of files to insert are relative to it.
            anywhere: as in `load`.

        Raises:
            FileNotFoundError: if a file to insert is missing.
            ValueError: as in `load`.
        """
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise ValueError(f"{name}: expected edits that kfgs saved ('format': {FORMAT!r}), got something else")
        if type(content.get("version")) is not int or content["version"] != VERSION:  # True and 1.0 equal 1
            raise ValueError(
                f"{name}: expected version {VERSION} of {FORMAT}, got {content.get('version')!r:.80}; install the kfgs "
                "that wrote it"
            )
        unknown = sorted(set(content) - {"format", "version", "edits", "undone"})
        if unknown:
            raise ValueError(f"{name}: expected 'edits' and 'undone', got {unknown[0]!r:.80}; correct or delete it")
        lists = {}
        for key in ("edits", "undone"):
            values = content.get(key, [])
            if not isinstance(values, list) or (key == "edits" and key not in content):
                raise ValueError(f"{name}: {key}: expected a list of edits, got {values!r:.80}; write it as [...]")
            try:
                lists[key] = tuple(_read(v, f"{key}[{i}]", as_path(folder), anywhere) for i, v in enumerate(values))
            except FileNotFoundError as error:
                raise FileNotFoundError(f"{name}: {error}") from error
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from error
        return EditList(**lists)


def _names() -> str:
    return ", ".join(kind.__name__ for kind in OPS.values())


def _written(edit: Edit, name: str, folder: Path) -> dict[str, Any]:
    try:
        return (edit.seen_from(folder) if isinstance(edit, Insert) else edit).to_json()
    except ValueError as error:
        raise ValueError(f"{name}.{error}") from error


def _read(value: Any, name: str, folder: Path, anywhere: bool) -> Edit:
    op = value.get("op") if isinstance(value, dict) else None
    if not isinstance(op, str) or op not in OPS:
        raise ValueError(
            f"{name}: expected an edit whose 'op' is one of {', '.join(OPS)}, got {value!r:.80}; correct it"
        )
    members = checked_object(name, value, OPS[op], "op")
    if isinstance(members.get("where"), dict):
        members["where"] = Where.from_json(members["where"], f"{name}.where")
    if isinstance(members.get("rotation"), dict):
        members["rotation"] = _read_turn(members["rotation"], f"{name}.rotation")
    if "source" in members:
        members["source"] = read_source(members["source"], f"{name}.source", folder, anywhere)
    if "similarity" in members:
        members["similarity"] = read_similarity(members["similarity"], f"{name}.similarity")
    return build(name, OPS[op], members)


def _read_turn(value: dict[str, Any], name: str) -> Turn:
    if set(value) != {"axis", "degrees"}:
        raise ValueError(f"{name}: expected axis and degrees, got {', '.join(value) or 'nothing'}; write both")
    return build(name, Turn, value)
