"""Masks of photos: where they are, how they are read, and what pycolmap gets of them. Black is ignored."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from .._files import Names, file_stem, real_path
from .files import MASKS, ORIENTATION, SMALL, SceneError, has_alpha, list_images, open_picture, read_alpha, some


def read_mask(path: Path, size: tuple[int, int]) -> Tensor:  # [H, W] bool
    """Which pixels of a photo of (H, W) count: those of its mask that are brighter than half of the brightest one.

    So masks of 0 and 1, of 0 and 255, and JPEG files mean the same; what is transparent is black. If the mask is larger than
    the photo, a pixel counts if all of it does.
    """
    with open_picture(path, "a mask of a photo", "write it again", small=max(SMALL, size[0] * size[1])) as picture:
        picture.getexif().pop(ORIENTATION, None)
        check_mask(path, picture.size, size)
        if picture.mode in ("1", "L") or picture.mode.startswith(("I", "F")):
            bright = np.asarray(picture)
        else:
            whole = picture.convert("RGBA")
            bright = np.asarray(Image.alpha_composite(Image.new("RGBA", whole.size, "black"), whole))[..., :3].max(2)
        return shrink_mask(torch.from_numpy(bright > bright.max() / 2), size)


def check_mask(path: Path, given: tuple[int, int], size: tuple[int, int]) -> None:
    """Raise a SceneError unless a mask of (width, height) pixels has the shape of a photo of (height, width) pixels."""
    (width, height), (rows, columns) = given, size
    if abs(width * rows - height * columns) > max(width + rows, height + columns):
        raise SceneError(
            f"{path}: expected a mask in the shape of its photo ({columns}x{rows} pixels), got {width}x{height}; make it of this "
            "photo, or take it away"
        )


def shrink_mask(mask: Tensor, size: tuple[int, int]) -> Tensor:  # [H, W] bool -> [h, w] bool
    """A mask at another size: a pixel counts if everything that it covers does."""
    if tuple(mask.shape) == tuple(size):
        return mask
    return torch.nn.functional.adaptive_max_pool2d((~mask)[None].float(), size)[0] == 0


def picture_folder(name: str, path: Path) -> Path:
    """The folder that the name of a picture is relative to."""
    return path.parents[len(Path(name).parts) - 1]


def folder_masks(
    names: Sequence[str], pictures: Path, root: Path | None = None
) -> tuple[list[Path | None] | None, list[str]]:
    """The mask of each photo, from a folder `masks`, and a note about them; None if no photo has one.

    The mask of `left/a.jpg` is `left/a.jpg.png` or `left/a.png`; other endings of pictures are read, too.

    Args:
        names: of the photos, relative to `pictures`.
        pictures: the folder of the photos; `masks` is in it or next to it.
        root: a folder whose `masks` is preferred.
    """
    places = [pictures] if pictures == root else [pictures, pictures.parent, real_path(pictures).parent]
    places = [place / MASKS for place in (*([] if root is None else [root]), *places)]
    folder, files = next(((place, files) for place in places if (files := list_images(place))), (pictures, []))
    if not files:
        return None, []
    known = Names(files)
    chosen = known.find_each(names)
    masks = [None if file is None else folder / file for file in chosen]
    taken = set(chosen) - {None}
    extra = [file for file in files if file not in taken]
    if len(extra) == len(files):
        example = f"{file_stem(names[0])}.png" if names else "NAME.png"
        count = f"none of {len(files)} masks ({some(files, 3)})"
        return None, [f"{folder}: {count} has the name of one photo, such as {example}; none is used"]
    note = f"masks: {len(taken)} of {len(names)} photos have one in {folder}; black is ignored"
    more = f"; {len(extra)} more have the name of no photo, or of several: {some(extra, 3)}"
    return masks, [note + (more if extra else "")]


def write_colmap_masks(folder: Path, photos: Mapping[str, tuple[Path, Path | None]]) -> str | None:
    """Write what pycolmap takes as `mask_path`: NAME.png for each photo, black where it is masked or transparent.

    `photos` has the file and the mask of each photo by its name. Returns the folder; None, if no photo has a mask or
    transparent pixels.
    """
    if not any(mask is not None or has_alpha(photo) for photo, mask in photos.values()):
        return None
    for name, (photo, mask) in photos.items():
        with open_picture(photo) as picture:
            size = picture.height, picture.width
        alpha, kept = read_alpha(photo), torch.ones(size, dtype=torch.bool) if mask is None else read_mask(mask, size)
        kept = kept if alpha is None else kept & (alpha > 0.5)
        place = folder / f"{name}.png"
        place.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(kept.numpy().astype(np.uint8) * 255).save(place)
    return str(folder)
