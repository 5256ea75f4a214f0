"""Flat pictures of a scene: labels over a photograph with a legend, feature maps as colours, PNG files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from .._card import short_repr
from .._check import check_range, check_shapes
from .._files import atomic_path
from .palette import palette

Array = np.ndarray[Any, Any]
LEGEND_INK, LEGEND_PAPER = (20, 20, 20), (255, 255, 255)


def overlay_labels(
    image: Tensor | Array,  # [H, W, 3] in [0, 1]
    labels: Tensor | Array,  # [H, W] int, -1 = none
    names: Sequence[str] | None = None,
    *,
    alpha: float = 0.55,
    boundaries: bool = True,
) -> Array:  # [H + legend, W, 3] uint8
    """Blend label colours over a photograph, draw the borders between labels, and add a legend below.

    Colours come from `palette`, so a class has the same colour in every view (skimage's `label2rgb` colours by the order
    of the labels present, and jumps between views). Pixels without a label are blended with grey.

    Args:
        image: the photograph or a rendering; values outside [0, 1] are clipped.
        labels: one per pixel of the image.
        names: class names by index; when given, the classes present are listed under the picture.
        alpha: weight of the label colours, in [0, 1].
        boundaries: darken the pixels on both sides of a border.

    Raises:
        ValueError: if sizes disagree, `alpha` is out of range, or a label has no name.
    """
    check_shapes(("image", image, "H W 3"), ("labels", labels, "H W"))
    check_range("alpha", alpha, 0, 1)
    photo, classes = np.clip(_array(image).astype(np.float64), 0, 1), _array(labels)
    blended = (1 - alpha) * photo + alpha * palette(classes) / 255
    if boundaries:
        from skimage.segmentation import find_boundaries

        blended[find_boundaries(classes, mode="thick")] *= 0.35
    picture = _to_bytes(blended)
    if names is None:
        return picture
    return np.concatenate([picture, legend_strip(classes, names, picture.shape[1])], axis=0)


def legend_strip(
    labels: Tensor | Array,  # any shape, int
    names: Sequence[str],
    width: int,
) -> Array:  # [h, width, 3] uint8
    """A strip that lists the classes present, each with its colour, wrapped to `width` pixels.

    Raises:
        ValueError: if a label has no name.
    """
    return _draw_legend(labels, names, width, int(np.clip(width / 40, 10, 22)))


def legend_column(
    labels: Tensor | Array,  # any shape, int
    names: Sequence[str],
    size: int = 14,
    *,
    height: int | None = None,
) -> Array:  # [h, w, 3] uint8
    """A column that lists the classes present, one per line, with letters of `size` pixels.

    Args:
        labels: the classes present are listed.
        names: class names by index.
        size: of the letters, pixels.
        height: begin another column where one would be higher than this many pixels; None: never.

    Raises:
        ValueError: if a label has no name.
    """
    return _draw_legend(labels, names, None, size, height)


def _draw_legend(
    labels: Tensor | Array, names: Sequence[str], width: int | None, size: int, height: int | None = None
) -> Array:
    """Entries from left to right, wrapped at `width`; without a width one per line, in columns up to `height`."""
    present = [int(label) for label in np.unique(_array(labels))]
    check_names(present, names)
    font = ImageFont.load_default(size=size)
    gap, line = size // 2, round(size * 1.6)
    x, y, right, bottom, left = gap, gap, gap, gap, gap
    places: list[tuple[int, int, int, str]] = []
    for label in present:
        text = "no class" if label < 0 else names[label]
        length = size + gap + round(font.getlength(text)) + 2 * gap
        if places and width is None and height is not None and y + line + gap // 2 > height:
            left, y = right, gap
            x = left
        if x > left and (width is None or x + length > width):
            x, y = left, y + line
        places.append((x, y, label, text))
        x += length
        right, bottom = max(right, x), max(bottom, y)
        if width is None:
            x, y = left, y + line
    strip = Image.new("RGB", (width or right, bottom + line + gap // 2), LEGEND_PAPER)
    draw = ImageDraw.Draw(strip)
    for x, y, label, text in places:
        color = tuple(int(v) for v in palette(np.array(label)))
        draw.rectangle((x, y, x + size - 1, y + size - 1), fill=color, outline=LEGEND_INK)
        draw.text((x + size + gap, y + size / 2), text, fill=LEGEND_INK, font=font, anchor="lm")
    return np.asarray(strip)


@dataclass(frozen=True, eq=False)
class FeatureColors:
    """One linear projection of features to RGB for a whole scene: equal features have equal colours in every view.

    Fit it once, on the codewords or on the Gaussians' features, and never on a frame: the principal axes of a single
    view change from view to view, and the colours with them.
    """

    mean: Tensor  # [D]
    axes: Tensor  # [D, 3] principal directions, strongest first
    low: Tensor  # [3] projection that becomes 0
    high: Tensor  # [3] projection that becomes 255

    __repr__ = short_repr

    @staticmethod
    def fit(
        features: Tensor,  # [N, D]
    ) -> FeatureColors:
        """Principal axes of the features; the range is their 1st to 99th percentile along each.

        Each axis points to the side where its largest entry is positive, so that refitting gives the same colours.
        With fewer than three channels, or on an axis without spread, the missing colours stay in the middle.

        Raises:
            ValueError: if there are no features or one is not finite.
        """
        check_shapes(("features", features, "N D"))
        rows = features.detach().double()
        if len(rows) == 0 or not bool(torch.isfinite(rows).all()):
            raise ValueError(
                f"features: expected at least one row of finite numbers, got {tuple(features.shape)} with "
                f"{int((~torch.isfinite(rows)).sum())} not finite; remove such rows first"
            )
        mean = rows.mean(dim=0)
        covariance = torch.cov(rows.T, correction=0).reshape(rows.shape[1], rows.shape[1])
        axes = torch.linalg.eigh(covariance).eigenvectors.flip(-1)[:, :3]
        largest = axes.gather(0, axes.abs().argmax(dim=0, keepdim=True))
        axes = torch.nn.functional.pad(axes * largest.sign(), (0, 3 - axes.shape[1]))
        projected = ((rows - mean) @ axes).cpu().numpy()
        low, high = torch.from_numpy(np.percentile(projected, [1, 99], axis=0)).to(rows.device)
        flat = (high - low) <= 1e-9 * mean.norm().clamp_min(1)
        return FeatureColors(mean, axes, torch.where(flat, -1, low), torch.where(flat, 1, high))

    def __call__(
        self,
        features: Tensor,  # [..., D], usually a map [H, W, D]
    ) -> Array:  # [..., 3] uint8
        """Colour features; projections outside the fitted range are clipped.

        Raises:
            ValueError: if D is not the fitted number of channels.
        """
        if features.shape[-1:] != self.mean.shape:
            raise ValueError(
                f"features: expected [..., D] with D = {len(self.mean)} (from fit), got {tuple(features.shape)}; "
                "fit on features of the same kind"
            )
        axes = self.axes / (self.high - self.low)
        offset = self.mean @ axes + self.low / (self.high - self.low)
        unit = features.detach() @ axes.to(features) - offset.to(features)
        return _to_bytes(unit.cpu().numpy())


def save_picture(
    path: str | Path,
    picture: Tensor | Array,  # [H, W], [H, W, 3] or [H, W, 4]; uint8, or floats in [0, 1]
) -> None:
    """Write a PNG file, whole or not at all. Floats are clipped to [0, 1].

    Raises:
        ValueError: if the name does not end in .png, or the array is no picture.
    """
    target, values = Path(path), _array(picture)
    if target.suffix.lower() != ".png":
        raise ValueError(f"path: expected a name that ends in .png, got {target.name!r}; rename it")
    if values.dtype != np.uint8 and not np.issubdtype(values.dtype, np.floating):
        raise ValueError(
            f"picture: expected uint8 or floats in [0, 1], got {values.dtype}; colour labels with palette()"
        )
    if values.ndim not in (2, 3) or (values.ndim == 3 and values.shape[2] not in (3, 4)) or 0 in values.shape:
        raise ValueError(f"picture: expected [H, W], [H, W, 3] or [H, W, 4], got {values.shape}; move channels last")
    data = as_bytes(values)
    with atomic_path(target) as temporary:
        Image.fromarray(np.ascontiguousarray(data)).save(temporary, format="PNG")


def as_bytes(picture: Tensor | Array) -> Array:
    """A picture in uint8: floats are clipped to [0, 1], bytes stay as they are."""
    values = _array(picture)
    return values if values.dtype == np.uint8 else _to_bytes(values)


def check_names(labels: Sequence[int], names: Sequence[str]) -> None:
    """Raise a ValueError if a label has no name, a TypeError if `names` is no list of names."""
    if isinstance(names, str) or not isinstance(names, Sequence):
        hint = "its .names" if hasattr(names, "names") else "a list"
        raise TypeError(f"names: expected a list of class names, got {type(names).__name__}; pass {hint}")
    if labels and max(labels) >= len(names):
        raise ValueError(
            f"names: expected a name for every label up to {max(labels)}, got {len(names)} names; pass all class names"
        )


def _array(values: Tensor | Array) -> Array:
    return values.detach().cpu().numpy() if isinstance(values, torch.Tensor) else np.asarray(values)


def _to_bytes(unit: Array) -> Array:
    """[0, 1] -> 0..255, rounded; NaN becomes black."""
    return np.asarray(np.round(np.clip(np.nan_to_num(unit, nan=0.0), 0, 1) * 255), dtype=np.uint8)
