"""Helpers for the files of a scene: names and their order, finding and reading images and their masks, and SceneError.

What is black in a mask, or transparent in a photo, is ignored.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from .._check import one_line
from .._files import Names, as_path, file_stem, folded_name, real_path

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp")
MASKS = "masks"  # the folder of the masks of photos, as in COLMAP, brush and LichtFeld
ORIENTATION = 0x0112  # EXIF's tag
PIXELS, SMALL, COLORS, PACKED = 1 << 27, 1 << 24, 9 << 20, 200
"""Most pixels of a picture (4 GB while it is read), and most for each byte of its file, which photos have about 10 of, beyond
SMALL (masks and labels: 3D-OVS's have 4032 x 3024 pixels, 400 a byte), or COLORS in colour (300 MB while it is read)."""
LONGEST = 400  # digits of a number in a name: no file's name is so long, a name in a stranger's table may be
MAX_SIDE = 100_000  # pixels: beyond any sensor, so a larger number is a wrong byte
MAX_NUMBER = 1e15  # of lengths and intrinsics: still far inside float32


class SceneError(ValueError):
    """A scene that cannot be used as it is; the message names the file, what was expected, what came, and what to do."""


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """A sort key under which rgb_5 comes before rgb_10."""
    parts = re.split(r"([0-9]+)", name)
    return [(0, int(part[:LONGEST]), part) if i % 2 else (1, 0, part) for i, part in enumerate(parts)]


def some(names: list[str], count: int = 5) -> str:
    """The first few of a list of names, for a message."""
    return ", ".join(names[:count]) + (f" and {len(names) - count} more" if len(names) > count else "")


def is_inside(name: str) -> bool:
    """Whether a name leads to a place inside its folder."""
    return bool(name) and not PurePosixPath(name).is_absolute() and ".." not in PurePosixPath(name).parts


def list_images(folder: str | Path, suffixes: tuple[str, ...] = IMAGE_SUFFIXES) -> list[str]:
    """Names of the image files in a folder and its subfolders, relative to it, in natural order.

    Hidden files and folders are left out, and so is a folder `masks` of the pictures; links to folders are not followed.
    """
    root = as_path(folder)
    names: list[str] = []
    for here, folders, files in os.walk(root):
        folders[:] = [name for name in folders if not (name.startswith(".") or (name == MASKS and here == str(root)))]
        shown = [name for name in files if not name.startswith(".") and name.lower().endswith(suffixes)]
        names += [(Path(here) / name).relative_to(root).as_posix() for name in shown]
    return sorted(names, key=natural_key)


def find_pictures(folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """The file of each name in a folder, as far as there is one: of this name, or the one that `Names` finds in its images."""
    files = {name: folder / name for name in names if os.path.isfile(folder / name)}
    lost = [name for name in names if name not in files]
    if lost:
        others = Names(name for name in list_images(folder) if name not in files)
        pairs = [(name, file) for name in reversed(lost) if (file := others.find(name)) is not None]
        pairs.sort(key=lambda pair: folded_name(pair[0]) == folded_name(pair[1]))
        nearest = {file: name for name, file in pairs}  # two names that are one file: the nearer one has it
        files |= {name: folder / file for file, name in nearest.items()}
    return files


def read_image(path: str | Path, background: str = "white") -> Tensor:  # [H, W, 3] float32 in [0, 1]
    """Read a PNG, JPEG, TIFF or WebP file. EXIF orientation is ignored, as by COLMAP.

    Transparent pixels are laid on white, as most cut-out objects are shown that networks were trained with; `Scene.image` lays
    them on black, before which colours are trained. Grey, palette, CMYK and 16-bit pictures are converted. kornia's reader
    refuses some of these. A SceneError if the file cannot be decoded, or has too many pixels for its size.
    """
    with open_picture(path, small=COLORS) as picture:
        if picture.mode.startswith(("I", "F")):
            if "transparency" in picture.info:
                raise ValueError("one of its 16-bit grey values is transparent: save it with an alpha channel")
            values = np.asarray(picture)
            if values.dtype.kind == "f" or values.min(initial=0) < 0 or values.max(initial=0) > 65535:
                raise ValueError(f"its pixels are {values.dtype}, not whole numbers of at most 16 bits")
            return torch.from_numpy(values.astype(np.float32) / 65535)[..., None].expand(-1, -1, 3).contiguous()
        shown: Image.Image = picture
        if _may_be_clear(picture):
            whole = picture.convert("RGBA")
            shown = Image.alpha_composite(Image.new("RGBA", whole.size, background), whole)
        return torch.from_numpy(np.array(shown.convert("RGB"))).float().div_(255)


def read_alpha(path: Path) -> Tensor | None:  # [H, W] float32 in [0, 1]
    """The opacity of a picture's pixels; None if all are opaque, or there is no such file."""
    if not os.path.isfile(path):
        return None
    with open_picture(path, small=COLORS) as picture:
        alpha = np.array(picture.convert("RGBA").getchannel("A")) if _may_be_clear(picture) else np.array([255])
        return None if alpha.min() == 255 else torch.from_numpy(alpha).float().div_(255)


def has_alpha(path: Path) -> bool:
    """Whether a file is a picture that may have transparent pixels, from its header."""
    with suppress(OSError, SceneError), open_picture(path) as picture:
        return _may_be_clear(picture)
    return False


def _may_be_clear(picture: Image.Image) -> bool:
    return not picture.mode.startswith(("I", "F")) and ("A" in picture.mode or "transparency" in picture.info)


@contextmanager
def open_picture(
    path: str | Path,
    expected: str = "a PNG, JPEG, TIFF or WebP image",
    advice: str = "replace the file or take it out of the scene",
    *,
    small: int = SMALL,
) -> Iterator[Image.Image]:
    """Open a picture; its pixels are read when they are used. Whatever fails meanwhile becomes a SceneError."""
    path = as_path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected {expected} there")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # our limits come next
            picture = Image.open(path)
        with picture:
            if picture.format == "TIFF":  # Pillow would turn it
                picture.getexif().pop(ORIENTATION, None)
            width, height = picture.size
            if width * height > min(PIXELS, max(small, PACKED * path.stat().st_size)):
                raise ValueError(f"{width}x{height} pixels in {path.stat().st_size} bytes are too many to be one")
            yield picture
    except Exception as error:  # hostile bytes raise almost anything, memory may be short
        why = one_line(error, 160) or type(error).__name__
        raise SceneError(f"{path}: expected {expected}, but it cannot be decoded ({why}); {advice}") from error


def picture_size(path: Path) -> tuple[int, int]:
    """(width, height) of a picture, from its header."""
    with open_picture(path, "a picture", "copy it again") as picture:
        return picture.size


@contextmanager
def scene_error(before: str = "", after: str = "") -> Iterator[None]:
    """Turn a ValueError into a SceneError, with more words before and after its own."""
    try:
        yield
    except ValueError as error:
        raise SceneError(f"{before}{error}{after}") from error


def read_mask(path: Path, size: tuple[int, int]) -> Tensor:  # [H, W] bool
    """Which pixels of a photo of (H, W) count: those of its mask that are brighter than half of the brightest one.

    So masks of 0 and 1, of 0 and 255, and JPEG files mean the same; what is transparent is black. If the mask is larger than
    the photo, a pixel counts if all of it does.
    """
    with open_picture(path, "a mask of a photo", "write it again", small=max(SMALL, size[0] * size[1])) as picture:
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
        expected = f"expected a mask in the shape of its photo ({columns}x{rows} pixels), got {width}x{height}"
        raise SceneError(f"{path}: {expected}; make it of this photo, or take it away")


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
    """The mask of each photo of a folder, and a note about them; None if no photo has one.

    They are in a folder `masks`: of `root`, else in `pictures` or next to it. The mask of `left/a.jpg` is `left/a.jpg.png` or
    `left/a.png`; other endings of pictures are read, too.
    """
    places = [pictures] if pictures == root else [pictures, pictures.parent, real_path(pictures).parent]
    places = [place / MASKS for place in (*([] if root is None else [root]), *places)]
    folder, files = next(((place, files) for place in places if (files := list_images(place))), (pictures, []))
    if not files:
        return None, []
    chosen = Names(files).find_each(names)
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

    `photos` has their files and masks by name. Returns the folder; None if no photo has a mask or transparent pixels.
    """
    if not any(mask is not None or has_alpha(photo) for photo, mask in photos.values()):
        return None
    for name, (photo, mask) in photos.items():
        size = picture_size(photo)[::-1]
        alpha, kept = read_alpha(photo), torch.ones(size, dtype=torch.bool) if mask is None else read_mask(mask, size)
        kept = kept if alpha is None else kept & (alpha > 0.5)
        place = folder / f"{name}.png"
        place.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(kept.numpy().astype(np.uint8) * 255).save(place)
    return str(folder)
