"""Features of a whole picture from a network that takes one square window: several scales, overlapping windows, flips.

The evaluation behind the paper's maps (`MultiEvalModule` of LSeg's script, with its constants), in little memory. All that
follows the network is linear and acts on rows and columns apart: enlarging its output twice, averaging where windows
overlap, cutting the padding off, resizing to the picture, and summing over scales. So each window's output G adds

    A_i G B_j^T     with     A_i = R[:, rows of window i] diag(1 / count) U

to the result, where U enlarges the output, count is how many windows cover a row, and R resizes rows of that scale to rows
of the picture (B_j likewise for columns). No map at full resolution is kept but the result. The matrices are made in
float64; the script's own resizing places samples in float32, up to 3e-5 of a pixel off.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from kornia.geometry.transform import resize
from torch import Tensor
from torch.nn import functional

BASE_OVER_CROP = 520 / 480  # a picture at scale 1 has a long side of 520 pixels, where the window has 480
_PADDING = -1.0  # black, once pictures are brought to [-1, 1]
_CHANNELS = 64  # of a window's output that are finished at a time: 44 MB at 360 x 480


class _Part(NamedTuple):
    """What one row of windows does to one axis of the result."""

    start: int  # first pixel of the window, at its scale
    low: int  # the part of the result, low : high, that the window reaches
    high: int
    matrix: Tensor  # [high - low, window / 2] float64: from a network's output to the result


def scaled_size(height: int, width: int, scale: float, window: int) -> tuple[int, int]:
    """Size (height, width) of a picture at a scale: the long side is ceil(520 scale) for a window of 480 pixels.

    The other side keeps the aspect, rounded half up, and is one pixel at least.
    """
    long = math.ceil(round(window * BASE_OVER_CROP * scale, 6))  # rounded first: 480.0000001 is 480
    short = max(1, int(min(height, width) * long / max(height, width) + 0.5))
    return (long, short) if height > width else (short, long)


def window_starts(length: int, window: int) -> list[int]:
    """First pixels of the windows over an axis of `length` pixels: two thirds of a window apart, the last over the end."""
    stride = int(window * 2 / 3)
    return [i * stride for i in range(math.ceil(max(0, length - window) / stride) + 1)]


def multi_scale_features(
    picture: Tensor,  # [3, H, W], -1 (black) to 1
    head: Callable[[Tensor], Tensor],
    *,
    window: int,
    scales: Sequence[float],
    flip: bool,
) -> Tensor:  # [D, H, W]
    """*Sum* over scales of the features of a picture, each scale averaged over overlapping windows and flips.

    At each scale the picture is resized (bilinear, corners aligned; see `scaled_size`) and cut into windows (see
    `window_starts`); one over the border is filled up with black, not moved inwards.

    Args:
        picture: the picture, of any size.
        head: the network, from [1, 3, window, window] to features [1, D, window / 2, window / 2].
        window: side of a window, pixels.
        scales: 1 is a long side of 13/12 window.
        flip: average with the features of the mirrored window.
    """
    _, H, W = picture.shape
    result: Tensor | None = None
    for scale in scales:
        h, w = scaled_size(H, W, scale, window)
        image = resize(picture[None], (h, w), align_corners=True)
        rows, columns = _parts(h, H, window), _parts(w, W, window)
        for row in rows:
            for column in columns:
                inside = image[..., row.start : row.start + window, column.start : column.start + window]
                right, below = window - inside.shape[-1], window - inside.shape[-2]
                crop = functional.pad(inside, (0, right, 0, below), value=_PADDING)
                output = head(crop)
                features = (output.lerp(head(crop.flip(-1)).flip(-1), 0.5) if flip else output)[0]
                if result is None:
                    result = features.new_zeros(features.shape[0], H, W)
                _add_(result, features, row, column)
    assert result is not None, "at least one scale"
    return result


def _add_(result: Tensor, features: Tensor, row: _Part, column: _Part) -> None:
    """Add A G B^T of one window to `result`, in place, some channels at a time."""
    A, B = (part.matrix.to(features.dtype).to(features.device) for part in (row, column))
    for start in range(0, len(features), _CHANNELS):
        channels = slice(start, start + _CHANNELS)
        across = features[channels] @ B.T  # [c, S/2, columns]
        result[channels, row.low : row.high, column.low : column.high] += A @ across


def _parts(length: int, out: int, window: int) -> list[_Part]:
    """The windows over one axis: `length` pixels at this scale, `out` in the result."""
    starts = window_starts(length, window)
    pixel = torch.arange(length)
    covered = torch.stack([(start <= pixel) & (pixel < start + window) for start in starts])  # [windows, length]
    count = covered.sum(dim=0).double()
    enlarge, resize = _interpolation(window // 2, window), _interpolation(length, out)
    parts = []
    for start in starts:
        end = min(start + window, length)
        matrix = resize[:, start:end] @ (enlarge[: end - start] / count[start:end, None])  # [out, window / 2]
        reached = matrix.any(dim=1).nonzero()
        low, high = (
            (int(reached[0]), int(reached[-1]) + 1) if len(reached) else (0, 0)
        )  # a far smaller result skips some
        parts.append(_Part(start, low, high, matrix[low:high]))
    return parts


def _interpolation(source: int, target: int) -> Tensor:  # [target, source] float64
    """The matrix of linear interpolation with aligned corners, from `source` samples to `target`: unit vectors, resized."""
    return resize(torch.eye(source, dtype=torch.float64)[None, None], (target, source), align_corners=True)[0, 0]
