"""A picture of examples: what was clicked, boxed or masked in the views, to see whether the clicks hit what was meant."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFilter
from PIL.Image import Resampling
from torch import Tensor

from .._check import as_array, check_shapes, check_whole
from ..cameras import Camera, as_cameras
from ..cameras.camera import view_named
from .palette import palette
from .pictures import LEGEND_INK, LEGEND_PAPER, Array, as_bytes, draw_legend, picture_sheet

COLUMNS = 3
MOST = 48  # views in one picture: of a data set with thousands, nobody looks at all
DOT, LINE = 4, 2  # pixels: radius of a point and width of a line; each has a rim
BRIGHT = 160  # mean of the channels; brighter colours have a dark rim, the others a white one
Color = tuple[int, ...]


def draw_examples(
    cameras: Sequence[Camera],
    examples: Mapping[str, Any],
    photo: Callable[[Camera], Tensor | Array],  # [H, W, 3] in [0, 1] or uint8
    *,
    width: int = 480,
) -> Array:  # [h, w, 3] uint8
    """Draw examples of classes in their views: points, boxes and outlines of masks in the class's colour, with a legend.

    Args:
        cameras: the views of the field (`field.cameras`). Pixels of examples are counted in their sizes.
        examples: as for `label_set_from_examples`. Those that are Gaussians lie in no view and are left out.
        photo: the picture of a view, in any size, for instance `lambda camera: scene.image(index[camera.name])`.
        width: width of a view in the picture, pixels.

    Returns:
        The views in the order of their first examples, at most 48, three in a row.

    Raises:
        ValueError: if no example lies in a view, or a view is unknown.
    """
    check_whole("width", width, 16)
    shown: dict[int, tuple[Camera, list[tuple[Any, Color]]]] = {}
    for label, (name, given) in enumerate(examples.items()):
        color = tuple(palette(np.array([label]), list(examples))[0].tolist())
        for i, example in enumerate(given if isinstance(given, Sequence) else [given]):
            if isinstance(example, Tensor) or not hasattr(example, "view"):
                continue
            camera = view_named(as_cameras(cameras), example.view, f"examples[{name!r}][{i}]")
            shown.setdefault(id(camera), (camera, []))[1].append((example, color))
    if not shown:
        raise ValueError("examples: expected at least one in a view, got none; pass Clicks, a Box or a Mask")
    views = list(shown.values())[:MOST]
    pictures = [_marked(camera, photo(camera), marks, width) for camera, marks in views]
    sheet = picture_sheet(pictures, [camera.name for camera, _ in views], COLUMNS)
    return np.concatenate([sheet, draw_legend(np.arange(len(examples)), list(examples), width=sheet.shape[1])])


def _marked(camera: Camera, photo: Tensor | Array, marks: list[tuple[Any, Color]], width: int) -> Array:
    """The photo at a width, with its marks."""
    from skimage.segmentation import find_boundaries

    check_shapes(("photo", photo, "H W 3"))
    size = width, max(1, round(camera.height * width / camera.width))  # Pillow's order
    picture = Image.fromarray(np.ascontiguousarray(as_bytes(photo))).resize(size, Resampling.BOX)
    pen, across, down = ImageDraw.Draw(picture), size[0] / camera.width, size[1] / camera.height
    for example, color in marks:
        rim = LEGEND_INK if sum(color) > 3 * BRIGHT else LEGEND_PAPER
        if hasattr(example, "mask"):
            check_shapes(("mask", example.mask, camera.size))
            mask = Image.fromarray(as_array(example.mask, "mask").astype(bool)).resize(size, Resampling.NEAREST)
            border = find_boundaries(np.pad(np.asarray(mask), 1), mode="inner")[1:-1, 1:-1]
            for wide, ink in ((2 * LINE + 1, rim), (LINE + 1, color)):
                picture.paste(ink, mask=Image.fromarray(border).convert("L").filter(ImageFilter.MaxFilter(wide)))
        elif hasattr(example, "corners"):
            x0, y0, x1, y1 = example.corners
            for wide, ink in ((2 * LINE, rim), (LINE, color)):
                pen.rectangle((x0 * across, y0 * down, x1 * across, y1 * down), outline=ink, width=wide)
        else:
            for x, y in ((x * across, y * down) for x, y in example.points):
                pen.ellipse((x - DOT, y - DOT, x + DOT, y + DOT), fill=color, outline=rim, width=LINE // 2)
    return np.asarray(picture)
