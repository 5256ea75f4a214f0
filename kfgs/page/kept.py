"""Packed scenes that are kept on disk: a page that was open before shows its scene while Python loads.

They lie in the user's folder for caches, which may be deleted at any time. Whoever uses one packs the scene again behind the
page, so that an outdated one is seen for seconds only.
"""

from __future__ import annotations

import hashlib
import os
import re
import sys
from collections.abc import Iterable
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

from .._files import atomic_path, digest_value, real_path

MOST, MOST_BYTES = 8, 1 << 30  # scenes that are kept; those that were not used for the longest time go first
ODD = (OSError, ValueError, RuntimeError, MemoryError)  # no reason to fail: no home, a full disk, an odd name
MOST_FILES = 20_000  # of all inputs together: looking at more takes longer than Python
CODE = Path(__file__).parents[1]


def scenes_folder() -> Path:
    """Where packed scenes are kept."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData/Local"
    elif sys.platform == "darwin":
        base = Path.home() / "Library/Caches"
    else:
        given = os.environ.get("XDG_CACHE_HOME", "")
        base = given if os.path.isabs(given) else Path.home() / ".cache"
    return Path(base) / "kfgs" / "view-scenes"


def scene_key(words: Iterable[object], inputs: Iterable[Path]) -> str | None:
    """What a packed scene depends on: the options, the names, sizes and dates of its files and folders, and kfgs itself.

    Files beside an input count if their names begin as its own does: labels lie there. What lies elsewhere and is only named
    in an input does not: the splat that a field was made on, the photos of the scene that it remembers. If these change, the
    old scene is shown until Python has packed the new one. None if there are too many files.
    """
    with suppress(*ODD):
        code = (file for folder in (CODE / "page", CODE / "viz/explorer") for file in folder.iterdir())
        files = [file for path in inputs for file in _files_of(real_path(path))]
        if len(files) <= MOST_FILES:
            dates = [(str(file), (state := file.stat()).st_size, state.st_mtime_ns) for file in sorted({*files, *code})]
            return digest_value([version("kfgs"), [str(word) for word in words], dates])
    return None


def read_scene(key: str) -> bytes | None:
    """The packed scene, if it is kept and whole."""
    with suppress(*ODD):
        path = scenes_folder() / key
        content = path.read_bytes()
        if hashlib.sha256(content[32:]).digest() == content[:32]:
            os.utime(path)
            return content[32:]
    return None


def keep_scene(key: str, packed: bytes) -> None:
    """Keep a packed scene for the next time. Where no file can be written, nothing is kept."""
    with suppress(*ODD):
        folder = scenes_folder()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with atomic_path(folder / key) as path, path.open("wb") as new:
            new.write(hashlib.sha256(packed).digest())
            new.write(packed)
        kept = [
            file for file in folder.iterdir() if re.fullmatch("[0-9a-f]{64}", file.name)
        ]  # the user's own files stay
        total = 0
        for number, file in enumerate(sorted(kept, key=lambda file: -file.stat().st_mtime_ns)):
            total += file.stat().st_size
            if number >= MOST or total > MOST_BYTES:
                file.unlink(missing_ok=True)


def _files_of(path: Path) -> list[Path]:
    """The files of a folder, or a file and those beside it whose names begin as its own; at most a few too many."""
    if not path.is_dir():
        return [
            file
            for file in path.parent.glob("*")
            if file.name.split(".")[0] == path.name.split(".")[0] and file.is_file()
        ]
    found: list[Path] = []
    for folder, _, names in os.walk(path):
        found += [Path(folder, name) for name in names]
        if len(found) > MOST_FILES:
            break
    return found
