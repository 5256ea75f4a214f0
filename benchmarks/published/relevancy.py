"""Parts that several protocols share: relevancy, the filters of LangSplat and LangSplatV2, and the overlap of two masks.

Each function follows the official evaluation script named in it, including its quirks, because they decide whether two
scores can be compared. `docs/protocols.md` lists the protocols that use them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from kfgs._check import check_choice, check_range, check_whole

Filter = Literal["langsplat", "langsplatv2"]
FILTERS = ("langsplat", "langsplatv2")
_Window = tuple[Tensor, Tensor]
"""First index, and one past the last, of the window of each place."""


def check_relevancy(scale: float, negatives: Sequence[str], threshold: float = 0.5) -> None:
    """Raise a ValueError unless the scale is positive, there are negatives, and the threshold lies in [0, 1]."""
    check_range("threshold", threshold, 0, 1)
    check_range("scale", scale, 0, closed=(False, False))
    if len(negatives) == 0:
        raise ValueError("negatives: expected at least one text to compare with, got none; name one, such as object")


def lerf_relevancy(
    positive: Tensor,  # [..., K] cosines with K texts
    negatives: Tensor,  # [..., M] cosines with M negatives
    scale: float = 10.0,
) -> Tensor:  # [..., K] in (0, 1)
    """LERF's relevancy: `min_j sigmoid(scale (p - n_j))`, the pairwise softmax with the least favourable negative.

    0.5 means "as similar as the best negative". LangSplat `eval/openclip_encoder.py`, after LERF (Kerr 2023).

    Example:
        >>> lerf_relevancy(torch.tensor([0.30]), torch.tensor([0.25, 0.20, 0.10, 0.28]))  # sigmoid(0.2)
        tensor([0.5498])
    """
    if negatives.ndim == 0 or negatives.shape[-1] == 0:
        raise ValueError(f"negatives: expected [..., M] with at least one, got {tuple(negatives.shape)}")
    return torch.sigmoid(scale * (positive - negatives.amax(-1, keepdim=True)))


def fill_unknown(
    maps: Tensor,  # [..., H, W]
) -> Tensor:  # [..., H, W]
    """Give pixels where nothing is known (NaN) the least known value of their map, or 0 if all are unknown.

    The official scripts have no unknown pixels: they decode a rendered zero into an arbitrary feature. The least value is
    neutral where maps are stretched: minimum and maximum stay as they were, and a threshold above 0 does not select it. A
    threshold of the relevancy itself (`legaussians-mip360/1`, `3dovs-threshold/1` unstretched) selects unknown pixels if it
    selects every known one. Smoothing before the stretching mixes them with their neighbours.
    """
    least = maps.nan_to_num(nan=torch.inf).amin((-2, -1), keepdim=True)
    return torch.where(maps.isnan(), least.masked_fill(least.isinf(), 0), maps)


def box_mean(
    maps: Tensor,  # [..., H, W]
    size: int = 30,
) -> Tensor:  # [..., H, W]
    """The mean of a square window, with OpenCV's offsets and border, as `cv2.filter2D` with a box in LangSplat.

    Pixel y averages rows y - size // 2 to y - size // 2 + size - 1: for 30, from -15 to +14. Beyond the border rows are
    mirrored without repeating the edge (`BORDER_REFLECT_101`).

    Raises:
        ValueError: if `size` is not a positive whole number.
    """
    check_whole("size", size, 1)
    height, width = maps.shape[-2:]
    before, after = size // 2, size - 1 - size // 2
    rows = _mirrored(-before, height + after, height).to(maps.device)
    columns = _mirrored(-before, width + after, width).to(maps.device)
    windows = [(torch.arange(n), torch.arange(n) + size) for n in (height, width)]
    return (_sums(maps.double()[..., rows, :][..., columns], *windows) / size**2).to(maps)


def pool_mean(
    maps: Tensor,  # [..., H, W]
    size: int = 29,
) -> Tensor:  # [..., H, W]
    """LangSplatV2's smoothing: the mean of a centred window of odd size, cut off at the border (`eval_lerf.py`)."""
    rows, columns = (_window(n, size // 2, skip_last=False) for n in maps.shape[-2:])
    return (_sums(maps.double(), rows, columns) / _areas(rows, columns).to(maps.device)).to(maps)


def majority(
    mask: Tensor,  # [..., H, W] bool
    size: int = 7,
    *,
    skip_last: bool = True,
) -> Tensor:  # [..., H, W] bool
    """Each pixel takes the more frequent value of its window; a tie is False. LangSplat `eval/utils.py`.

    The window of row i has the rows max(0, i - 3) to min(i + 4, H - 1) - 1, and so for columns.

    Args:
        mask: any number of masks.
        size: of the window, odd.
        skip_last: LangSplat's off-by-one: the last row and the last column take part in no window. False repairs it.

    Raises:
        ValueError: if `size` is even.
    """
    if size % 2 == 0:
        raise ValueError(f"size: expected an odd number of pixels, got {size}; use {size + 1}")
    rows, columns = (_window(n, size // 2, skip_last=skip_last) for n in mask.shape[-2:])
    return 2 * _sums(mask.int(), rows, columns) > _areas(rows, columns).to(mask.device)


def pool_majority(
    mask: Tensor,  # [..., H, W] bool
    size: int = 7,
) -> Tensor:  # [..., H, W] bool
    """LangSplatV2's majority: average pooling > 0.5, where pixels beyond the border count as False (`eval_lerf.py`)."""
    rows, columns = (_window(n, size // 2, skip_last=False) for n in mask.shape[-2:])
    return 2 * _sums(mask.int(), rows, columns) > size**2


def smooth_relevancy(maps: Tensor, filter: Filter) -> Tensor:  # [..., H, W] -> [..., H, W]
    """The mean that a script takes before it looks for maxima and masks: 30 x 30 (LangSplat) or 29 x 29 (LangSplatV2)."""
    check_choice("filter", filter, FILTERS)
    return box_mean(maps) if filter == "langsplat" else pool_mean(maps)


def clean_mask(mask: Tensor, filter: Filter) -> Tensor:  # [..., H, W] bool -> [..., H, W] bool
    """The 7 x 7 majority of a script."""
    check_choice("filter", filter, FILTERS)
    return majority(mask) if filter == "langsplat" else pool_majority(mask)


def stretch(
    values: Tensor,  # [..., *axes]
    axes: int = 2,
) -> Tensor:
    """Bring values to [-1, 1] by their minimum and maximum over the last `axes` axes, and clip to [0, 1] (LangSplat).

    N = (R - min) / (max(R - min) + 1e-9), then clip(2 N - 1, 0, 1): the lower half becomes 0.

    Example:
        >>> stretch(torch.tensor([0.2, 0.4, 0.5, 0.6]), axes=1)
        tensor([0.0000, 0.0000, 0.5000, 1.0000])
    """
    over = tuple(range(-axes, 0))
    values = values - values.amin(over, keepdim=True)
    return (2 * values / (values.amax(over, keepdim=True) + 1e-9) - 1).clamp(0, 1)


def mask_iou(
    predicted: Tensor,  # [...] bool
    truth: Tensor,  # [...] bool
    empty: float = 0.0,
) -> float:
    """Intersection over union of two masks; `empty` if neither holds a pixel.

    Raises:
        ValueError: if shapes differ.

    Example:
        >>> mask_iou(torch.tensor([True, True, False]), torch.tensor([False, True, True]))
        0.3333333333333333
    """
    if predicted.shape != truth.shape:
        raise ValueError(
            f"predicted: expected the size of the truth, {tuple(truth.shape)}, got {tuple(predicted.shape)}; "
            "use cameras of the size of the annotated pictures"
        )
    truth = truth.to(predicted.device)
    union = int((predicted | truth).sum())
    return int((predicted & truth).sum()) / union if union else empty


def _mirrored(start: int, stop: int, size: int) -> Tensor:  # [stop - start] int64
    """Indices start .. stop - 1, reflected into 0 .. size - 1 without repeating the edges."""
    if size == 1:
        return torch.zeros(stop - start, dtype=torch.int64)
    places = torch.arange(start, stop).remainder(2 * (size - 1))
    return torch.minimum(places, 2 * (size - 1) - places)


def _window(size: int, reach: int, *, skip_last: bool) -> _Window:
    places = torch.arange(size)
    stop = (places + reach + 1).clamp_max(size - 1 if skip_last else size)
    return torch.minimum((places - reach).clamp_min(0), stop), stop


def _sums(values: Tensor, rows: _Window, columns: _Window) -> Tensor:  # [..., H, W] -> [..., h, w]
    """The sum of each window, by running sums: as quick for 30 pixels as for 3. In float64, or whole numbers."""
    dtype = torch.float64 if values.is_floating_point() else torch.int32  # cumsum would make int32 int64
    (top, bottom), (left, right) = (tuple(x.to(values.device) for x in window) for window in (rows, columns))
    running = F.pad(values.cumsum(-1, dtype=dtype), (1, 0))
    across = running.index_select(-1, right) - running.index_select(-1, left)
    running = F.pad(across.cumsum(-2, dtype=dtype), (0, 0, 1, 0))
    return running.index_select(-2, bottom) - running.index_select(-2, top)


def _areas(rows: _Window, columns: _Window) -> Tensor:  # [h, w] int64
    return (rows[1] - rows[0])[:, None] * (columns[1] - columns[0])
