"""Choose the COLMAP model of a scene folder: COLMAP and hloc write several if they cannot join all images."""

from __future__ import annotations

from pathlib import Path

from .._files import real_path
from .colmap_model import count_images, has_model
from .files import natural_key, some

PLACES = ("sparse", "colmap/sparse", "dense/sparse", "distorted/sparse", "colmap_ground_truth", ".")
"""Folders of models, asked in this order; a model may also lie in their subfolders `N`, `N/models/M` and `models/M`."""


def models_of(path: Path) -> list[Path]:
    """The models of the first of `PLACES` that has some; in a subfolder without a number only if there is no other."""
    for folder in (path / place for place in PLACES) if path.is_dir() else ():
        inner = [] if folder == path else [below for below in _folders(folder) if below.name != "models"]
        numbered = [below for below in inner if below.name.isdecimal()]
        hloc = [model for below in (folder, *numbered) for model in _folders(below / "models")]
        for places in ([*numbered, *hloc, folder], inner):
            if models := [place for place in places if has_model(place)]:
                return models
    return []


def find_model(path: Path) -> Path | None:
    """The COLMAP model that `load_scene` reads in a scene folder, the one with most images; None if there is none."""
    return max(models_of(path), key=count_images, default=None)  # the first of equal ones


def choice_note(path: Path, model: Path) -> list[str]:
    """A note if the scene has other models than the one that was chosen."""
    others = [other for other in models_of(path) if other != model]
    listed = some([f"{other.relative_to(path)} with {count_images(other)} images" for other in others])
    note = f"{model.relative_to(path)} with {count_images(model)} images is used, the largest of several models"
    return (
        [f"{note}; there is {listed} too: to use another, give its folder as the scene, as in {others[0]}"]
        if others
        else []
    )


def above(model: Path) -> list[Path]:
    """The folders above a model that may be its scene, nearest first: two, or all up to the one that holds `PLACES`."""
    parents = list(real_path(model).parents)[:6]
    names = [folder.name for folder in parents]
    if "sparse" not in names:
        return parents[:2]
    count = names.index("sparse") + 2
    return parents[: count + (names[count - 1 : count] in (["colmap"], ["dense"], ["distorted"]))]


def _folders(folder: Path) -> list[Path]:
    inner = [below for below in folder.iterdir() if below.is_dir()] if folder.is_dir() else []
    return sorted(inner, key=lambda below: natural_key(below.name))
