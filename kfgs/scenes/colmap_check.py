"""Is this folder a whole, honest COLMAP model? Asked before pycolmap is let near it.

pycolmap 4.2.1 does not defend itself: a truncated cameras.bin loads with wrong intrinsics, a corrupt points3D.bin
takes all memory, random bytes in frames.bin never return. So kfgs walks every file first, with memory bounded by the
file's size, and hands over only what is whole.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from .colmap_binary import read_binary
from .colmap_tables import Model
from .colmap_text import read_text
from .errors import SceneError

TABLES = ("cameras", "images", "points3D")


@dataclass(frozen=True)
class ModelSummary:
    """What a checked COLMAP model holds."""

    layout: str
    """`"binary"` or `"text"`: what pycolmap will read (it prefers binary)."""
    cameras: int
    images: int
    points: int
    rigs: int
    """0 in the old three-file layout."""


def has_model(path: str | Path) -> bool:
    """Whether a folder holds a COLMAP cameras or images file, whole or not."""
    return any((Path(path) / f"{table}.{suffix}").is_file() for table in TABLES[:2] for suffix in ("bin", "txt"))


def check_model(path: str | Path) -> ModelSummary:
    """Check every file of a COLMAP model: binary or text, three files or five (rigs, frames).

    Checked are: each count against the file's size, the exact end of each file, camera model ids and their number of
    parameters, finite numbers and plausible sizes, unit quaternions, names inside the image folder, ids that are
    unique and refer to something that exists. Not checked: that the poses are right.

    Args:
        path: the folder with `cameras`, `images`, `points3D` and perhaps `rigs`, `frames`, as .bin or as .txt.

    Raises:
        FileNotFoundError: if there is no such folder.
        SceneError: naming the file, what was expected, what came and what to do.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder; expected a COLMAP model there")
    for suffix in ("bin", "txt"):
        if all((folder / f"{table}.{suffix}").is_file() for table in TABLES):
            model: Model = read_binary(folder) if suffix == "bin" else read_text(folder)
            layout = "binary" if suffix == "bin" else "text"
            return ModelSummary(layout, len(model.cameras), len(model.images), model.points, len(model.rigs or ()))
    present = sorted(file.name for file in folder.iterdir() if file.stem in TABLES)
    raise SceneError(
        f"{folder}: expected a COLMAP model (cameras, images and points3D, all as .bin or all as .txt), got "
        f"{', '.join(present) or 'none of these files'}; copy the missing files or run COLMAP (`kfgs sfm`)"
    )
