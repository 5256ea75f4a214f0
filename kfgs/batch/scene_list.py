"""The list of scenes of a batch: a text file with a scene per line."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from .._check import one_line
from .._files import as_path, read_text, real_path

SHOWN = 5  # lines named in an error
NAME = re.compile(r"[^\s./\\][^/\\\0-\x1f]*")  # a folder of that name can be made anywhere, and is not hidden


@dataclass(frozen=True)
class SceneEntry:
    """A scene of a batch."""

    name: str
    """Its run is the folder `out/<name>`."""
    source: str
    """Absolute path of the scene, or of a folder of photos."""


def read_scenes(path: str | Path) -> list[SceneEntry]:
    """Read a list of scenes: a folder per line, relative to that of the list; `#` starts a comment.

    The last part of the path is the name of the run; `name = folder` gives another one.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it lists no scene, two runs have the same name, or a folder does not exist; lines are numbered.
    """
    path = as_path(path)
    lines = read_text(path, "a list of scenes, a folder per line,").splitlines()
    texts = {number: re.sub(r"(^|\s)#.*", "", line).strip() for number, line in enumerate(lines, start=1)}
    entries = {number: _entry(text, path.parent) for number, text in texts.items() if text}
    faults, first = [] if entries else ["no scene"], dict[str, int]()
    for number, entry in entries.items():
        if NAME.fullmatch(entry.name) is None:
            faults.append(f"line {number}: {one_line(entry.name)!r} cannot be the name of a run; write `NAME = SCENE`")
        elif not Path(entry.source).is_dir():
            faults.append(f"line {number}: {one_line(entry.source, 300)} is not a folder")
        elif first.setdefault(entry.name, number) != number:
            faults.append(f"line {number}: {entry.name!r} is line {first[entry.name]}'s name; write `NAME = SCENE`")
    if faults:
        more = [f"and {len(faults) - SHOWN} more"] if len(faults) > SHOWN else []
        got = "; ".join(faults[:SHOWN] + more)
        raise ValueError(f"{path}: expected an existing scene and a new name in each line, got {got}")
    return list(entries.values())


def as_entries(scenes: Iterable[str | Path | SceneEntry], out: Path) -> list[SceneEntry]:
    """Scenes given by their folders or as entries; a ValueError for equal names, and for a run inside a scene."""
    if isinstance(scenes, str | Path):
        raise ValueError(f"scenes: expected a list, got {str(scenes)!r}; call read_scenes for a file")
    entries = [scene if isinstance(scene, SceneEntry) else _entry(str(scene), Path()) for scene in scenes]
    names, sources = [entry.name for entry in entries], {real_path(entry.source) for entry in entries}
    odd = next((name for name in names if NAME.fullmatch(name) is None or names.count(name) > 1), None)
    if odd is not None or not entries:
        got = "no scene" if odd is None else one_line(odd)
        raise ValueError(f"scenes: expected scenes with different names, got {got}; pass SceneEntry(name, source)")
    for run in (real_path(out) / name for name in names):
        if sources & {run, *run.parents}:
            raise ValueError(
                f"out: expected a folder apart from all scenes, got {out}, which puts {run.name!r} into one"
            )
    return entries


def _entry(text: str, folder: Path) -> SceneEntry:
    name, given, source = (part.strip() for part in text.partition(" = "))
    place = (folder / as_path(source if given else name)).absolute()
    return SceneEntry(name if given else place.name, str(place))
