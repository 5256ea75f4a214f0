"""What killed writers of the first versions of kfgs left: `.NAME.ab12cd34` beside NAME, for files with NAME's suffix again."""

from __future__ import annotations

import functools
import os
import re
import shutil
import time
from contextlib import suppress
from pathlib import Path

AGE = 86_400  # seconds without a change: its writer has ended
RANDOM = re.compile(
    r"\..+\.[a-z0-9_]{8}(\.\w+)?"
)  # as `tempfile` names files; folders named `.old` may be a user's only copy


def sweep_former(target: Path, new: Path) -> None:
    """Delete what is left of earlier attempts to write `target`, when `new` is ready to take its place.

    Only what is surely of kfgs goes: a file with both the name and the suffix of the target, or a folder that holds nothing
    but files of names that are in `new`; and neither has changed for a day.
    """
    ending = "" if new.is_dir() else re.escape(target.suffix)
    known = {path.relative_to(new) for path in new.rglob("*")}
    for place in _left_in(target.parent):
        if re.fullmatch(rf"\.{re.escape(target.name)}\.[a-z0-9_]{{8}}{ending}", place.name) and not place.is_symlink():
            with suppress(OSError):
                inside = list(place.rglob("*"))
                idle = time.time() - max(path.lstat().st_mtime for path in (place, *inside)) > AGE
                if not idle or place.is_dir() != new.is_dir() or {path.relative_to(place) for path in inside} - known:
                    continue
                shutil.rmtree(place) if place.is_dir() else place.unlink()


@functools.lru_cache(maxsize=1000)
def _left_in(folder: Path) -> tuple[Path, ...]:
    """Looked up once in a process: a folder of maps is written to thousands of times."""
    with suppress(OSError):
        return tuple(folder / name for name in os.listdir(folder) if RANDOM.fullmatch(name))
    return ()
