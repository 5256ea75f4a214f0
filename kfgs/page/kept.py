"""Packed scenes that are kept on disk: a page that was open before shows its scene while Python loads.

They lie in the user's folder for caches, which may be deleted at any time. Whoever uses one packs the scene again behind the
page, so that an outdated one is seen for seconds only.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from .._files import atomic_path, digest_value, real_path

MOST = 8  # scenes that are kept; the one that was not used for the longest time goes first
MOST_FILES = 20_000  # of all inputs together: looking at more takes longer than Python
CODE = Path(__file__).parents[1]


def scenes_folder() -> Path:
    """Where packed scenes are kept."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData/Local"
    elif sys.platform == "darwin":
        base = Path.home() / "Library/Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "kfgs" / "scenes"


def scene_key(words: Iterable[object], inputs: Iterable[Path]) -> str | None:
    """What a packed scene depends on: the options, the names, sizes and dates of its files and folders, and kfgs itself.

    Files beside an input count if their names begin as its own does: labels lie there. None if there are too many files.
    """
    code = (file for folder in (CODE / "page", CODE / "viz/explorer") for file in folder.iterdir())
    files = [file for path in inputs for file in _files_of(real_path(path))]
    if len(files) > MOST_FILES:
        return None
    try:
        dates = [(str(file), (state := file.stat()).st_size, state.st_mtime_ns) for file in sorted({*files, *code})]
    except OSError:  # deleted meanwhile
        return None
    return digest_value([[str(word) for word in words], dates])


def read_scene(key: str) -> bytes | None:
    """The packed scene, if it is kept and whole."""
    with suppress(OSError):
        path = scenes_folder() / key
        content = path.read_bytes()
        if hashlib.sha256(content[32:]).digest() == content[:32]:
            os.utime(path)
            return content[32:]
    return None


def keep_scene(key: str, packed: bytes) -> None:
    """Keep a packed scene for the next time. Where no file can be written, nothing is kept."""
    with suppress(OSError, RuntimeError):  # RuntimeError: there is no home folder
        folder = scenes_folder()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with atomic_path(folder / key) as path:
            path.write_bytes(hashlib.sha256(packed).digest() + packed)
        kept = sorted((file for file in folder.iterdir() if file.is_file()), key=lambda file: file.stat().st_mtime_ns)
        for file in kept[:-MOST]:
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
