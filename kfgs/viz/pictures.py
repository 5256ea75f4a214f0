"""2-D pictures: labels over a photograph, legends, grids of pictures, PNG files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from PIL.Image import Resampling
from torch import Tensor
from torch.nn.functional import interpolate

from .._check import as_array, check_range, check_shapes, check_whole
from .._files import as_path, atomic_path
from .palette import palette

Array = np.ndarray[Any, Any]
GAP = 6  # pixels between pictures of a grid
LEGEND_INK, LEGEND_PAPER = (20, 20, 20), (255, 255, 255)


def overlay_labels(
    image: Tensor | Array,  # [H, W, 3] in [0, 1]
    labels: Tensor | Array,  # [H, W] int, -1 = none
    names: Any = None,
    *,
    alpha: float = 0.55,
    legend: bool = True,
) -> Array:  # [H + legend, W, 3] uint8
    """Blend label colours over a photograph, draw the borders between labels, and add a legend below.

    Colours come from `palette`, so a class has the same colour in every view, and with `names` in every scene. (skimage's
    `label2rgb` colours by the order of the labels present, which changes between views.) No label is grey.

    Args:
        image: the photograph or a rendering; values outside [0, 1] are clipped.
        labels: one per pixel of the image.
        names: class names by index, or what has them (a field, a cloud, a label set): they decide the colours, and the
            classes present are listed under the picture.
        alpha: weight of the label colours, in [0, 1].
        legend: False: names decide the colours only.

    Raises:
        ValueError: if sizes disagree, `alpha` is out of range, or a label has no name.
    """
    from skimage.segmentation import find_boundaries

    check_shapes(("image", image, "H W 3"), ("labels", labels, "H W"))
    check_range("alpha", alpha, 0, 1)
    photo, classes = np.clip(as_array(image, "image").astype(np.float64), 0, 1), as_array(labels, "labels")
    blended = (1 - alpha) * photo + alpha * palette(classes, names) / 255
    blended[find_boundaries(classes, mode="thick")] *= 0.35
    picture = as_bytes(blended)
    if names is None or not legend:
        return picture
    return np.concatenate([picture, draw_legend(classes, names, width=picture.shape[1])], axis=0)


def draw_legend(
    labels: Tensor | Array,  # any shape, int
    names: Any,
    *,
    size: int | None = None,
    width: int | None = None,
    height: int | None = None,
) -> Array:  # [h, w, 3] uint8
    """A legend of the classes present, with letters of `size` pixels; a ValueError if a label has no name.

    With a width, entries go from left to right and wrap, and the size follows from it. Without, there is one entry per line,
    in columns of at most `height`.
    """
    size = int(np.clip((width or 0) / 40, 10, 22)) if size is None else size
    present, names = [int(label) for label in np.unique(as_array(labels, "labels"))], getattr(names, "names", names)
    swatches = palette(np.array(present), names)
    font = ImageFont.load_default(size=size)
    gap, line = size // 2, round(size * 1.6)
    x, y, right, bottom, left = gap, gap, gap, gap, gap
    places: list[tuple[int, int, tuple[int, ...], str]] = []
    for label, swatch in zip(present, swatches.tolist(), strict=True):
        text = "no class" if label < 0 else names[label]
        length = size + gap + round(font.getlength(text)) + 2 * gap
        if places and width is None and height is not None and y + line + gap // 2 > height:
            left, x, y = right, right, gap
        if x > left and (width is None or x + length > width):
            x, y = left, y + line
        places.append((x, y, tuple(swatch), text))
        x += length
        right, bottom = max(right, x), max(bottom, y)
        if width is None:
            x, y = left, y + line
    strip = Image.new("RGB", (width or right, bottom + line + gap // 2), LEGEND_PAPER)
    draw = ImageDraw.Draw(strip)
    for x, y, color, text in places:
        draw.rectangle((x, y, x + size - 1, y + size - 1), fill=color, outline=LEGEND_INK)
        draw.text((x + size + gap, y + size / 2), text, fill=LEGEND_INK, font=font, anchor="lm")
    return np.asarray(strip)


def save_picture(
    path: str | Path,
    picture: Tensor | Array,  # [H, W], [H, W, 3] or [H, W, 4]; uint8, or floats in [0, 1]
) -> None:
    """Write a PNG file, whole or not at all. Floats are clipped to [0, 1]; a ValueError if the name does not end in .png."""
    with atomic_path(check_suffix(path, ".png")) as temporary:
        Image.fromarray(np.ascontiguousarray(as_bytes(picture))).save(temporary, format="PNG")


def picture_grid(
    rows: Sequence[Sequence[Tensor | Array]],  # each [H, W, 3] in [0, 1] or uint8
    titles: Sequence[str] = (),
    *,
    width: int | None = None,
    names: Sequence[str] = (),
) -> Array:  # [h, w, 3] uint8
    """Lay pictures out in rows, with a title over each column, and a legend below.

    Args:
        rows: R rows of C pictures. Smaller ones stand in the middle of their row and column.
        titles: C titles, or none. Letters grow with the sheet: it is legible at the width of a page.
        width: width of each picture in pixels; all pictures are resized to it and to the proportions of the first in their
            row. Shrinking averages pixels. Enlarging repeats them, so that a coarse map looks coarse.
        names: the classes of the legend; () draws none.

    Raises:
        ValueError: if there is no picture, rows or titles differ in number, or `width` is not a positive whole number.

    Example:
        >>> photo, coarse = np.zeros((60, 80, 3)), np.ones((6, 8, 3))
        >>> picture_grid([[photo, coarse]], width=40).shape  # two of 30 x 40, and 6 pixels around each
        (42, 98, 3)
    """
    counts = [len(row) for row in (*rows, titles or rows[0])] if rows else [0]
    if 0 in counts or len(set(counts)) != 1:
        raise ValueError(f"rows, titles: expected equally many in each row, got {counts}; fill them up")
    for i, j in np.ndindex(len(rows), len(rows[0])):
        check_shapes((f"rows[{i}][{j}]", rows[i][j], "H W 3"))
    pictures = [[as_bytes(picture) for picture in row] for row in rows]
    if width is not None:
        check_whole("width", width, 1)
        for row in pictures:
            size = int(width), max(1, round(row[0].shape[0] * int(width) / row[0].shape[1]))  # Pillow's order
            # a box filter takes the mean of the pixels covered; when enlarging, the pixel itself
            row[:] = [np.asarray(Image.fromarray(np.ascontiguousarray(p)).resize(size, Resampling.BOX)) for p in row]
    heights = [max(picture.shape[0] for picture in row) for row in pictures]
    width = max(picture.shape[1] for row in pictures for picture in row)
    columns = len(rows[0])
    fits = [int(100 * width / (ImageFont.load_default(size=100).getlength(title) or 1)) for title in titles]
    letters = max(12, min([max(width // 28, columns * width // 48), *fits]))  # pixels
    head = (letters * 3 // 2 if titles else 0) + GAP
    sheet = np.full((head + sum(heights) + len(rows) * GAP, GAP + columns * (width + GAP), 3), 255, np.uint8)
    for i, j in np.ndindex(len(rows), columns):
        picture = pictures[i][j]
        top = head + sum(heights[:i]) + i * GAP + (heights[i] - picture.shape[0]) // 2
        left = GAP + j * (width + GAP) + (width - picture.shape[1]) // 2
        sheet[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    canvas = Image.fromarray(sheet)
    draw, font = ImageDraw.Draw(canvas), ImageFont.load_default(size=letters)
    for j, title in enumerate(titles):
        draw.text((GAP + j * (width + GAP) + width / 2, head / 2), title, fill=LEGEND_INK, font=font, anchor="mm")
    legend = [draw_legend(np.arange(len(names)), names, width=canvas.width)] if len(names) else []
    return np.concatenate([np.asarray(canvas), *legend])


def picture_sheet(pictures: Sequence[Array], titles: Sequence[str], columns: int, *, width: int | None = None) -> Array:
    """Pictures in rows of at most `columns`, each with its own title."""
    columns = min(columns, len(pictures))
    blank = [np.full((1, pictures[0].shape[1], 3), 255, np.uint8)] * (-len(pictures) % columns)
    cells, words = [*pictures, *blank], [*titles, *[""] * len(blank)]
    starts = range(0, len(cells), columns)
    return np.concatenate([picture_grid([cells[i : i + columns]], words[i : i + columns], width=width) for i in starts])


def resize_photo(photo: Tensor, size: tuple[int, int]) -> Tensor:  # [H, W, 3] -> [h, w, 3]
    """Resize a photograph to (height, width): each new pixel is the mean of the old ones it covers."""
    return interpolate(photo.permute(2, 0, 1)[None], size, mode="area")[0].permute(1, 2, 0)


def check_suffix(path: str | Path, *endings: str, name: str = "path") -> Path:
    """The path; a ValueError unless its name ends in one of these."""
    target = as_path(path)
    if target.suffix.lower() not in endings:
        raise ValueError(f"{name}: expected a name that ends in {' or '.join(endings)}, got {target.name!r}; rename it")
    return target


def as_bytes(picture: Tensor | Array) -> Array:
    """A picture in uint8: floats are clipped to [0, 1] and rounded, NaN is black; bytes stay as they are."""
    values = as_array(picture, "picture")
    if values.dtype == np.uint8:
        return values
    return np.asarray(np.round(np.clip(np.nan_to_num(values, nan=0.0), 0, 1) * 255), dtype=np.uint8)
