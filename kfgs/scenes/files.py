"""Finding image files."""

from __future__ import annotations

import os
from pathlib import Path

from .names import natural_key
from .scene import IMAGE_SUFFIXES


def list_images(folder: str | Path) -> list[str]:
    """Names of the image files in a folder and its subfolders, relative to it, in natural order.

    Hidden files and folders are left out; links to folders are not followed.
    """
    root = Path(folder)
    names: list[str] = []
    for here, folders, files in os.walk(root):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in files:
            if not name.startswith(".") and name.lower().endswith(IMAGE_SUFFIXES):
                names.append((Path(here) / name).relative_to(root).as_posix())
    return sorted(names, key=natural_key)
