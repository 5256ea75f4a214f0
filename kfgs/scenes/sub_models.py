"""Choose the COLMAP model of a scene folder: COLMAP and hloc write several if they cannot join all images."""

from __future__ import annotations

import struct
from pathlib import Path

from .._files import real_path, text_encoding
from .colmap_model import has_model
from .files import natural_key, some

PLACES = ("sparse", "colmap/sparse", "dense/sparse", "distorted/sparse", "colmap_ground_truth", ".")
"""Folders of models, asked in this order; a model may also lie in their subfolders `N`, `N/models/M` and `models/M`."""
IMAGE = 73  # bytes of an image without 2-D points, with a name of one letter


def models_of(path: Path) -> list[Path]:
    """The models of the first of `PLACES` that has some; in a subfolder without a number only if there is no other."""
    for folder in (path / place for place in PLACES) if path.is_dir() else ():
        inner = [] if folder == path else [below for below in _folders(folder) if below.name != "models"]
        numbered = [below for below in inner if below.name.isdecimal()]
        hloc = [model for below in (folder, *numbered) for model in _folders(below / "models")]
        for places in ([*numbered, *hloc, folder], inner):
            models = [place for place in places if has_model(place)]
            if models:
                return models
    return []


def find_model(path: Path) -> Path | None:
    """The COLMAP model that `load_scene` reads in a scene folder, the one with most images; None if there is none."""
    models = models_of(path)
    return max(models, key=count_images) if len(models) > 1 else next(iter(models), None)  # the first of equal ones


def choice_note(path: Path, model: Path) -> list[str]:
    """A note if the scene has other models than the one that was chosen."""
    others = [other for other in models_of(path) if other != model]
    if not others:
        return []
    listed = some([f"{other.relative_to(path)} with {count_images(other)} images" for other in others])
    return [
        f"{model.relative_to(path)} with {count_images(model)} images is used, the largest of several models; there is {listed} "
        f"too: to use another, give its folder as the scene, as in {others[0]}"
    ]


def above(model: Path) -> list[Path]:
    """The folders above a model that may be its scene, nearest first: two, or all up to the one that holds `PLACES`."""
    parents = list(real_path(model).parents)[:6]
    names = [folder.name for folder in parents]
    if "sparse" not in names:
        return parents[:2]
    count = names.index("sparse") + 2
    return parents[: count + (names[count - 1 : count] in (["colmap"], ["dense"], ["distorted"]))]


def count_images(model: Path) -> int:
    """The number of images in a model, without reading them; 0 if it is damaged."""
    binary, text = (model / f"images.{suffix}" for suffix in ("bin", "txt"))
    try:
        if binary.is_file():
            with binary.open("rb") as file:
                count = int(struct.unpack("<Q", file.read(8))[0])
            return count if count * IMAGE <= binary.stat().st_size else 0
        with text.open(encoding=text_encoding(text)) as lines:  # each is followed by a line of its 2-D points
            return sum(next(lines, "") != "" for line in lines if line.strip() and not line.lstrip().startswith("#"))
    except (OSError, ValueError, struct.error):
        return 0


def _folders(folder: Path) -> list[Path]:
    inner = [below for below in folder.iterdir() if below.is_dir()] if folder.is_dir() else []
    return sorted(inner, key=lambda below: natural_key(below.name))
