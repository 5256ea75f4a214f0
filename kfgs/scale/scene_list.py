"""The list of scenes of a batch: a text file with a scene per line."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path, PurePath

from .._check import one_line
from .._files import as_path, read_text, real_path

SHOWN = 5  # lines named in an error
NAME = re.compile(r"[^\s./\\][^/\\\0-\x1f]*")  # a folder of that name can be made anywhere, and is not hidden
URL = re.compile(r"[a-z][a-z0-9+.-]*://", re.IGNORECASE)


@dataclass(frozen=True)
class SceneEntry:
    """A scene of a batch."""

    name: str
    """Of its run: RUNS/<name>."""
    source: str
    """An absolute path, or a URL of fsspec."""


def is_url(place: str) -> bool:
    """Whether a place is a URL such as `s3://bucket/scene`; else it is a path."""
    return URL.match(place) is not None


def read_scenes(path: str | Path) -> list[SceneEntry]:
    """Read a list of scenes: one per line, `#` before a comment, blank lines ignored.

    A line is a folder (relative to that of the list) or a URL of fsspec. Its last part is the name of the run;
    `name = folder` gives another one.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it lists no scene, two runs have the same name, or a folder does not exist; lines are numbered.
    """
    path = as_path(path)
    lines = read_text(path, "a list of scenes, a folder or an URL per line,").splitlines()
    numbered = [(number, re.sub(r"(^|\s)#.*", "", line).strip()) for number, line in enumerate(lines, start=1)]
    found = {number: _entry(line, path.parent) for number, line in numbered if line}
    if not found:
        raise ValueError(
            f"{path}: expected a scene in a line, got none in {len(lines)} lines; write a folder or an URL into one"
        )
    faults = {number: fault for number, entry in found.items() if (fault := _fault(entry)) is not None}
    first: dict[str, int] = {}
    for number, entry in found.items():
        if first.setdefault(entry.name, number) != number and number not in faults:
            faults[number] = (
                f"the run of line {first[entry.name]} is called {entry.name!r}, too; write `NAME = SCENE` to name it"
            )
    if faults:
        shown = [f"line {number}: {fault}" for number, fault in sorted(faults.items())[:SHOWN]]
        more = [f"and {len(faults) - SHOWN} more"] if len(faults) > SHOWN else []
        raise ValueError(
            f"{path}: expected an existing scene and a new name in each line, got " + "; ".join(shown + more)
        )
    return list(found.values())


def as_entries(scenes: Iterable[str | Path | SceneEntry]) -> list[SceneEntry]:
    """Scenes given in Python, by their places or as entries.

    Raises:
        ValueError: if there are none, or two runs have the same name.
    """
    if isinstance(scenes, str | Path):
        raise ValueError(
            f"scenes: expected a list, got {str(scenes)!r}; put it into one, or call read_scenes for a file"
        )
    entries = [scene if isinstance(scene, SceneEntry) else _entry(str(scene), Path()) for scene in scenes]
    names = [entry.name for entry in entries]
    for name in names:
        if NAME.fullmatch(name) is None:
            raise ValueError(
                f"scenes: expected names that folders can have, got {one_line(name)!r}; pass SceneEntry(name, source)"
            )
    if not entries or len(set(names)) < len(names):
        twice = next((name for name in names if names.count(name) > 1), None)
        got = "none" if twice is None else f"{twice!r} more than once"
        raise ValueError(
            f"scenes: expected scenes, each with a name of its own, got {got}; pass SceneEntry(name, source)"
        )
    return entries


def check_apart(entries: Iterable[SceneEntry], out: str | Path) -> None:
    """Check that no run, `out/<name>`, is the folder of a scene or lies in one: a scene stays as it is.

    Raises:
        ValueError: if one does.
    """
    entries, root = list(entries), _spot(str(out))
    scenes = {_spot(entry.source) for entry in entries}
    for run in (root / entry.name for entry in entries):
        scene = next((place for place in (run, *run.parents) if place in scenes), None)
        if scene is not None:
            raise ValueError(
                f"out: expected a place apart from all scenes, got {out}, so that {run.name!r} would be written to the scene "
                f"{scene}; give another"
            )


def _spot(place: str) -> PurePath:
    """A place that can be compared; links are followed."""
    return PurePath(place) if is_url(place) else real_path(place)


def _entry(line: str, folder: Path) -> SceneEntry:
    name, given, source = (part.strip() for part in line.partition(" = "))
    source = source if given else name
    if not is_url(source):
        source = str((folder / as_path(source)).absolute())
    return SceneEntry(name if given else source.rstrip("/").rpartition("/")[2], source)


def _fault(entry: SceneEntry) -> str | None:
    if NAME.fullmatch(entry.name) is None:
        return f"{one_line(entry.name)!r} cannot be the name of a run; write `NAME = SCENE`"
    if not is_url(entry.source) and not Path(entry.source).is_dir():
        what = "is a file" if Path(entry.source).exists() else "does not exist"
        return f"{one_line(entry.source, 300)} {what}; expected the folder of a scene or of photos"
    return None
