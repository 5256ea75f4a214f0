"""The list of scenes of a batch: a text file with a scene per line."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from .._check import one_line
from .._files import as_path, read_text, real_path

NAME = re.compile(r"[^\s./\\][^/\\\0-\x1f]*")  # a folder of that name can be made anywhere, and is not hidden


def read_scenes(path: str | Path) -> dict[str, str]:
    """Read a list of scenes: a folder per line, relative to that of the list; `#` starts a comment.

    The last part of the path is the name of the run; `name = folder` gives another one.

    Returns:
        The absolute path of each scene, or of a folder of photos, by the name of its run.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it lists no scene, two runs have the same name, or a folder does not exist; lines are numbered.
    """
    path = as_path(path)
    if path.is_dir():
        raise ValueError(f"{path}: expected a text file with a scene in each line, got a folder; write one")
    lines = read_text(path, "a list of scenes, a folder per line,").splitlines()
    texts = {number: re.sub(r"(^|\s)#.*", "", line).strip() for number, line in enumerate(lines, start=1)}
    scenes, faults, first = dict[str, str](), list[str](), dict[str, int]()
    for number, text in texts.items():
        if text:
            name, given, source = (part.strip() for part in text.partition(" = "))
            place = (path.parent / as_path(source if given else name)).absolute()
            name = name if given else place.name
            if NAME.fullmatch(name) is None:
                faults.append(f"line {number}: {one_line(name)!r} cannot be the name of a run; write `NAME = SCENE`")
            elif not place.is_dir():
                faults.append(f"line {number}: {one_line(place, 300)} is not a folder")
            elif first.setdefault(name, number) != number:
                faults.append(f"line {number}: {name!r} is line {first[name]}'s name; write `NAME = SCENE`")
            scenes[name] = str(place)
    if faults or not scenes:
        got = "; ".join(faults) or "no scene"
        raise ValueError(f"{path}: expected an existing scene and a new name in each line, got {got}")
    return scenes


def check_scenes(scenes: Mapping[str, str | Path], out: Path) -> dict[str, Path]:
    """The absolute path of each scene by name; a ValueError if a name cannot be a folder's, or a run would be in a scene."""
    if not isinstance(scenes, Mapping) or not scenes or not all(map(NAME.fullmatch, scenes)):
        raise ValueError(f"scenes: expected scenes by the names of their runs, got {scenes!r:.80}; call read_scenes")
    places = {name: as_path(source).absolute() for name, source in scenes.items()}
    sources = set(map(real_path, places.values()))
    for run in (real_path(out) / name for name in places):
        if sources & {run, *run.parents}:
            raise ValueError(f"out: expected a folder apart from all scenes, got {out}; {run.name!r} would lie in one")
    return places
