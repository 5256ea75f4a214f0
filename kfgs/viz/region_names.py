"""Class names written on the large regions of a picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from .._check import as_array, check_range, check_shapes
from .pictures import Array, check_names

FITS = 0.9  # share of a name's box that must lie in its region


def write_region_names(
    picture: Array,  # [H, W, 3] uint8
    labels: Tensor | Array,  # [H, W] int, -1 = none
    names: Sequence[str],
    *,
    least: float = 0.01,
) -> Array:  # [H, W, 3] uint8
    """Write the name of its class on each large region of a picture, where the region is widest.

    Args:
        picture: for instance from `overlay_labels`.
        labels: one per pixel of the picture; regions without a label get no name.
        names: class names by index.
        least: smallest region with a name, as a share of the picture. Regions too narrow for their name get none.

    Raises:
        ValueError: if sizes disagree, `least` is not in [0, 1], or a label has no name.
    """
    from scipy import ndimage

    check_shapes(("picture", picture, "H W 3"), ("labels", labels, "H W"))
    check_range("least", least, 0, 1)
    classes = as_array(labels, "labels")
    present = [int(label) for label in np.unique(classes) if label >= 0]
    check_names(present, names)
    size = max(11, classes.shape[1] // 34)
    font = ImageFont.load_default(size=size)
    canvas = Image.fromarray(np.ascontiguousarray(picture))
    draw = ImageDraw.Draw(canvas)
    for label in present:
        regions, _ = ndimage.label(classes == label)
        areas = np.bincount(regions.ravel())
        wide, high = round(font.getlength(names[label])) + 4, size + 4
        for number in np.flatnonzero(areas >= max(least * classes.size, 1)):
            if number == 0:  # everything else
                continue
            inside = regions == number
            share = ndimage.uniform_filter(inside.astype(np.float32), (high, wide), mode="constant")
            depth = ndimage.distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1]
            depth = np.where(share >= FITS, depth, 0)
            if depth.any():
                widest = np.argwhere(depth >= depth.max() - 0.5)
                y, x = widest[np.abs(widest - widest.mean(axis=0)).sum(axis=1).argmin()]
                x, y = np.clip((x, y), (wide / 2, high / 2), (classes.shape[1] - wide / 2, classes.shape[0] - high / 2))
                draw.text((float(x), float(y)), names[label], "white", font, "mm", stroke_width=2, stroke_fill="black")
    return np.asarray(canvas)
