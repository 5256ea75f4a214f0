"""Choose the pictures to make or find maps for: views of a scene, or a list."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from torch import Tensor

from .._typed import typed
from ..scenes import Scene, read_image
from ..scenes.files import some

Split = str | Sequence[str] | Sequence[int]
"""The name of a split, `all`, or a list of view names or indices."""


@dataclass(frozen=True)
class Picture:
    """One picture: the name of its view, its file, and its size if it is known."""

    stem: str
    """The view's name without its suffix; its map has the same stem."""
    path: Path
    size: tuple[int, int] | None = None
    """(H, W) in pixels."""

    def read(self) -> Tensor:  # [H, W, 3] float32 RGB in [0, 1]
        """Read the file; raises as `scenes.read_image`."""
        return read_image(self.path)


@typed
def pictures_of(scene: Scene, split: Split = "all") -> list[Picture]:
    """The pictures of some views of a scene, as they are on disk.

    Lens distortion is not removed, even if the scene is undistorted: `fit_scene` removes it from the maps
    (`FitConfig.undistorted_features` is False).

    Args:
        scene: the views.
        split: the name of a split, `all`, or a list of view names or indices.

    Raises:
        ValueError: if the scene has no such split or view, or the split is empty.
    """
    if isinstance(split, str):
        split = scene.views(split)
    chosen = scene.select(split)
    return [Picture(chosen.stem(i), chosen.image_paths[i], chosen.cameras[i].size) for i in range(len(chosen))]


def as_pictures(pictures: Scene | Sequence[Picture], split: Split, *, exist: bool = False) -> list[Picture]:
    """The pictures of a scene's split, or the list as it was given.

    Raises:
        TypeError: if `pictures` is neither.
        ValueError: if there are none, two have the same stem, a stem leads out of the folder of maps, or a list has a split.
        FileNotFoundError: if they must `exist`, and one does not.
    """
    if isinstance(pictures, Scene):
        pictures = pictures_of(pictures, split)
    elif not isinstance(pictures, Sequence) or not all(isinstance(picture, Picture) for picture in pictures):
        raise TypeError(
            f"pictures: expected a Scene or a list of Picture, got {type(pictures).__name__}; pass load_scene(folder)"
        )
    elif split != "train":
        raise ValueError(f"split: expected none with a list of pictures, got {split!r}; leave it out")
    check_stems("pictures", [picture.stem for picture in pictures])
    for picture in pictures:
        parts = PurePosixPath(picture.stem)
        if not picture.stem or parts.is_absolute() or ".." in parts.parts:
            raise ValueError(
                f"stem: expected a name within the folder of maps, got {picture.stem!r}; rename the picture"
            )
        if exist and not picture.path.is_file():
            raise FileNotFoundError(f"{picture.path}: no such file; expected the picture of view {picture.stem!r}")
    return list(pictures)


def check_stems(name: str, stems: Sequence[str]) -> None:
    """Raise an error unless an argument is a list of different stems: a TypeError for a text, else a ValueError."""
    if isinstance(stems, str):
        raise TypeError(f"{name}: expected a list of image stems, got the text {stems!r}; put it into a list")
    if not stems:
        raise ValueError(f"{name}: expected at least one view, got none; name the views")
    if len(set(stems)) != len(stems):
        twice = sorted({stem for stem in stems if stems.count(stem) > 1})
        raise ValueError(f"{name}: expected each stem once, got {some(twice)} more than once; remove or rename repeats")
