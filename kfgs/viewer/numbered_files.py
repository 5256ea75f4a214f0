"""Reserve the next numbered file or folder, so that two programs can save into one folder without loss."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path


@contextmanager
def numbered_path(folder: Path, stem: str, suffix: str = "") -> Iterator[Path]:
    """Create the first free `stem_001`, a file or (without a suffix) a folder, for the caller to fill.

    Removes it again if the caller's code raises.
    """
    new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    path = _take(folder, stem, suffix)
    try:
        yield path
    except BaseException:
        with suppress(OSError):  # a folder that is not empty stays
            path.unlink() if suffix else path.rmdir()
            if new:
                folder.rmdir()
        raise


def _take(folder: Path, stem: str, suffix: str) -> Path:
    taken = {path.stem for path in folder.glob(f"{stem}_*")}
    for number in count(1):
        path = folder / f"{stem}_{number:03d}{suffix}"
        if path.stem in taken:
            continue
        with suppress(FileExistsError):  # another program was quicker
            path.touch(exist_ok=False) if suffix else path.mkdir()
            return path
    raise AssertionError("numbers end nowhere")
