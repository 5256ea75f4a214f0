"""Pictures in rows and columns under their titles: a scene before and after, from one viewpoint a row."""

from __future__ import annotations

import numbers
from collections.abc import Sequence
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from PIL.Image import Resampling
from torch import Tensor

from .._check import check_shapes
from .pictures import as_bytes

Array = np.ndarray[Any, Any]
GAP = 6  # pixels between pictures
INK, PAPER = (20, 20, 20), 255


def picture_grid(
    rows: Sequence[Sequence[Tensor | Array]],  # each [H, W, 3] in [0, 1] or uint8
    titles: Sequence[str] = (),
    *,
    width: int | None = None,
) -> Array:  # [h, w, 3] uint8
    """Lay pictures out in rows, with a title over each column.

    Args:
        rows: R rows of C pictures, of one size unless a `width` is given.
        titles: C titles, or none.
        width: pixels across each picture; the height follows from the shape of the first one, and all others are brought
            to that size: a feature map in colours beside its photograph, or small pictures of large photographs.
            Shrinking averages, enlarging repeats pixels, so that a coarse map looks as coarse as it is.

    Raises:
        ValueError: if there is no picture, rows or titles differ in number, pictures in size without a `width`, or `width`
            is no positive whole number.

    Example:
        >>> photo, coarse = np.zeros((60, 80, 3)), np.ones((6, 8, 3))
        >>> picture_grid([[photo, coarse]], width=40).shape  # two of 30 x 40, and 6 pixels around each
        (42, 98, 3)
    """
    if not rows or not rows[0] or len({len(row) for row in rows}) != 1:
        raise ValueError(
            f"rows: expected rows of equally many pictures, got {[len(row) for row in rows]}; fill them up"
        )
    if titles and len(titles) != len(rows[0]):
        raise ValueError(f"titles: expected {len(rows[0])} (one per column), got {len(titles)}; give one for each")
    named = [(f"rows[{i}][{j}]", picture, "H W 3") for i, row in enumerate(rows) for j, picture in enumerate(row)]
    for one in named:
        check_shapes(one)
    pictures = [[as_bytes(picture) for picture in row] for row in rows]
    if width is not None:
        pictures = _resize_alike(pictures, width)
    height, width = pictures[0][0].shape[:2]
    for (name, picture, _), shown in zip(named, (picture for row in pictures for picture in row), strict=True):
        if shown.shape[:2] != (height, width):
            raise ValueError(
                f"{name}: expected [H, W, 3] with H = {height}, W = {width} (from rows[0][0]), got {tuple(picture.shape)}; "
                f"say picture_grid(..., width={width}) to resize"
            )
    letters = max(12, width // 28)  # pixels
    head = (letters * 3 // 2 if titles else 0) + GAP
    columns = len(rows[0])
    sheet = np.full((head + len(rows) * (height + GAP), GAP + columns * (width + GAP), 3), PAPER, np.uint8)
    for i, row in enumerate(pictures):
        for j, picture in enumerate(row):
            top, left = head + i * (height + GAP), GAP + j * (width + GAP)
            sheet[top : top + height, left : left + width] = picture
    canvas = Image.fromarray(sheet)
    draw, font = ImageDraw.Draw(canvas), ImageFont.load_default(size=letters)
    for j, title in enumerate(titles):
        draw.text((GAP + j * (width + GAP) + width / 2, head / 2), title, fill=INK, font=font, anchor="mm")
    return np.asarray(canvas)


def _resize_alike(pictures: list[list[Array]], width: int) -> list[list[Array]]:
    """All pictures `width` pixels wide and in the proportions of the first."""
    if not isinstance(width, numbers.Integral) or width < 1:
        raise ValueError(
            f"width: expected a positive whole number of pixels, got {width!r}; pass an integer such as 320"
        )
    if not all(picture.size for row in pictures for picture in row):
        raise ValueError("rows: expected pictures of at least one pixel, got an empty one; leave it out")
    high, wide = pictures[0][0].shape[:2]
    size = int(width), max(1, round(high * int(width) / wide))  # Pillow's order
    # a box filter is the mean of the pixels covered, and where fewer than one is covered the pixel itself
    return [
        [np.asarray(Image.fromarray(np.ascontiguousarray(p)).resize(size, Resampling.BOX)) for p in row]
        for row in pictures
    ]
