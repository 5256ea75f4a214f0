"""Helpers for the files of a scene: names and their order, finding and reading images, and SceneError."""

from __future__ import annotations

import os
import re
from pathlib import Path, PurePosixPath
from typing import Any

from kornia.io import ImageLoadType, load_image
from torch import Tensor

from .._files import as_path, read_json

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp")  # kornia decodes these
MAX_SIDE = 100_000  # pixels: beyond any sensor, so a larger number is a wrong byte
MAX_NUMBER = 1e15  # of lengths and intrinsics: still far inside float32


class SceneError(ValueError):
    """A scene that cannot be used as it is.

    The message names the file, what was expected, what was found, and what to do.
    """


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """A sort key under which rgb_5 comes before rgb_10.

    Example:
        >>> sorted(["rgb_10", "rgb_5"], key=natural_key)
        ['rgb_5', 'rgb_10']
    """
    parts = re.split(r"([0-9]+)", name)
    return [(0, int(part), part) if i % 2 else (1, 0, part) for i, part in enumerate(parts)]


def file_stem(name: str) -> str:
    """A view's name without its suffix, folders kept. Feature and label files of the view carry this name.

    Example:
        >>> file_stem("rgb_5.png"), file_stem("train/r_0.png")
        ('rgb_5', 'train/r_0')
    """
    path = PurePosixPath(name)
    return str(path.with_suffix("")) if path.name else name  # "/" and "." have no suffix to take


def some(names: list[str], count: int = 5) -> str:
    """The first few of a list of names, for a message."""
    return ", ".join(names[:count]) + (f" and {len(names) - count} more" if len(names) > count else "")


def is_file(path: Path) -> bool:
    """Whether there is a file under this path; False for a name that is too long for the disk, where Path.is_file raises."""
    try:
        return path.is_file()
    except OSError:
        return False


def list_images(folder: str | Path) -> list[str]:
    """Names of the image files in a folder and its subfolders, relative to it, in natural order.

    Hidden files and folders are left out; links to folders are not followed.
    """
    root = as_path(folder)
    names: list[str] = []
    for here, folders, files in os.walk(root):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in files:
            if not name.startswith(".") and name.lower().endswith(IMAGE_SUFFIXES):
                names.append((Path(here) / name).relative_to(root).as_posix())
    return sorted(names, key=natural_key)


def read_image(path: str | Path) -> Tensor:  # [H, W, 3] float32 in [0, 1]
    """Read a PNG, JPEG, TIFF or WebP file. Transparent pixels are laid on white; EXIF orientation is ignored, as by COLMAP.

    Raises:
        FileNotFoundError: if there is no such file.
        SceneError: if it cannot be decoded.
    """
    path = as_path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected an image there")
    try:
        image = load_image(str(path), ImageLoadType.RGB32)
    except (ValueError, RuntimeError, OSError) as error:
        raise SceneError(
            f"{path}: expected a PNG, JPEG, TIFF or WebP image, but it cannot be decoded ({error}); "
            "replace the file or take it out of the scene"
        ) from error
    return image.permute(1, 2, 0).contiguous()


def read_scene_json(path: str | Path, advice: str) -> Any:
    """Read a JSON file.

    Raises:
        FileNotFoundError: if there is no such file.
        SceneError: if it is no JSON; the message ends with `advice`.
    """
    try:
        return read_json(path)
    except ValueError as error:
        raise SceneError(f"{error}; {advice}") from error
    except RecursionError as error:
        raise SceneError(f"{path}: expected a JSON file, got brackets nested too deep; {advice}") from error
