"""Pictures in rows and columns under their titles: a scene before and after, from one viewpoint a row."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from .._check import check_shapes
from .pictures import as_bytes

Array = np.ndarray[Any, Any]
GAP = 6  # pixels between pictures
INK, PAPER = (20, 20, 20), 255


def picture_grid(
    rows: Sequence[Sequence[Tensor | Array]],  # each [H, W, 3] in [0, 1] or uint8
    titles: Sequence[str] = (),
) -> Array:  # [h, w, 3] uint8
    """Lay pictures of one size out in rows, with a title over each column.

    Args:
        rows: R rows of C pictures.
        titles: C titles, or none.

    Raises:
        ValueError: if there is no picture, rows or titles differ in number, or pictures in size.
    """
    if not rows or not rows[0] or len({len(row) for row in rows}) != 1:
        raise ValueError(
            f"rows: expected rows of equally many pictures, got {[len(row) for row in rows]}; fill them up"
        )
    if titles and len(titles) != len(rows[0]):
        raise ValueError(f"titles: expected {len(rows[0])} (one per column), got {len(titles)}; give one for each")
    check_shapes(
        *[(f"rows[{i}][{j}]", picture, "H W 3") for i, row in enumerate(rows) for j, picture in enumerate(row)]
    )
    pictures = [[as_bytes(picture) for picture in row] for row in rows]
    height, width = pictures[0][0].shape[:2]
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
