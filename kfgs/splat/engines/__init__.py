"""The compositing engines: what they compute (`contract`), which there are (`table`), and the calls that check arguments."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..._check import check_shapes, check_whole
from .contract import ALPHA_MIN, Ranked, Splats, Tiles
from .cpu.memory import free_memory
from .table import available_engines, choose

__all__ = [
    "ALPHA_MIN",
    "accumulate_pixels",
    "available_engines",
    "composite",
    "free_memory",
    "rank_channels",
]


def composite(
    means2d: Tensor,  # [M, 2] pixels (x, y)
    conics: Tensor,  # [M, 3] (a, b, c)
    opacities: Tensor,  # [M]
    features: Tensor,  # [N, D]
    tiles: Tiles,
    *,
    background: Tensor | None = None,  # [D]
    index: Tensor | None = None,  # [M] int64
    engine: str = "auto",
) -> tuple[Tensor, Tensor]:  # maps [H, W, D], alphas [H, W]
    """Composite the projected Gaussians of each tile front to back (Eq. 1-2 of 3DGS, for any number of channels).

    `kfgs.splat.engines.contract` says exactly what is computed.

    Args:
        means2d: centres; the centre of the first pixel is (0.5, 0.5).
        conics: inverse 2-D covariances.
        opacities: in (0, 1).
        features: what is composited; any number of channels from 1.
        tiles: from `bin_tiles` on the same Gaussians.
        background: what shows through, zeros if None.
        index: the row of `features` that each Gaussian shows, as `Projected.index`; None: row m for Gaussian m, N = M.
            It saves copies of the visible rows and of their gradients.
        engine: a name of `available_engines()`, or "auto": the fastest one for the tensors' device.

    Returns:
        The composited features and the opacity of every pixel, differentiable in all tensors but `tiles`, once.

    Raises:
        ValueError: if shapes, dtypes or devices disagree, `tiles` or `index` belong to other Gaussians, or the engine is
            unknown or does not know the device or the dtype.
        ImportError: if the named engine's package is missing.

    Note:
        On the CPU, large arrays are kept for the next frames, up to 1 GiB per thread.
    """
    splats, tiles = _check_splats(means2d, conics, opacities, features, tiles, background, index)
    return choose(engine, means2d.device.type, means2d.dtype).composite(splats, tiles)


@torch.no_grad()
def rank_channels(
    means2d: Tensor,  # [M, 2]
    conics: Tensor,  # [M, 3]
    opacities: Tensor,  # [M]
    features: Tensor,  # [N, D] finite scores
    tiles: Tiles,
    *,
    top: int = 1,
    early: bool = False,
    index: Tensor | None = None,  # [M] int64
    engine: str = "auto",
) -> Ranked:
    """`composite` and arg-max in one kernel, see `kfgs.splat.rasterize_labels`; the maps [H, W, D] never reach memory."""
    splats, tiles = _check_splats(means2d, conics, opacities, features, tiles, None, index)
    check_whole("top", top, 1, features.shape[1])
    return choose(engine, means2d.device.type, means2d.dtype).rank(splats, tiles, top, early)


@torch.no_grad()
def accumulate_pixels(
    means2d: Tensor,  # [M, 2]
    conics: Tensor,  # [M, 3]
    opacities: Tensor,  # [M]
    pixels: Tensor,  # [H, W, D]
    tiles: Tiles,
    *,
    engine: str = "auto",
) -> tuple[Tensor, Tensor]:  # sums [M, D], weights [M]
    """Sum per-pixel values into the Gaussians, each weighted by how much the Gaussian shows at the pixel.

    The sums are weights^T · pixels, the adjoint of `composite` in `features`. Uplifting, visibility and pruning by
    importance need them. Both results come from one walk over the view, and carry no gradient.

    Args:
        means2d, conics, opacities, tiles, engine: as in `composite`.
        pixels: one signal per pixel, any number of channels.

    Returns:
        The sums, and the sum of each Gaussian's weights: divide by it for a mean.

    Raises:
        ValueError: as `composite`, and if `pixels` is not as large as the image of `tiles`.
    """
    splats, tiles = _check_splats(means2d, conics, opacities, means2d, tiles, None, None)  # any features will do
    check_shapes(("pixels", pixels, (tiles.height, tiles.width, "D")))
    _check_alike("pixels", pixels, means2d)
    chosen = choose(engine, means2d.device.type, means2d.dtype)
    return chosen.accumulate(*splats[:3], pixels.contiguous(), tiles)


def _check_splats(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    features: Tensor,
    tiles: Tiles,
    background: Tensor | None,
    index: Tensor | None,
) -> tuple[Splats, Tiles]:
    """Check the arguments of a call and make an engine's of them: contiguous, and no index beyond its tensor's memory."""
    check_sizes(*tiles[2:], prefix="tiles.")
    rows, columns = tiles.grid
    check_shapes(
        ("means2d", means2d, "M 2"),
        ("conics", conics, "M 3"),
        ("opacities", opacities, "M"),
        ("features", features, "M D" if index is None else "N D"),
        ("background", background, "D"),
        ("index", index, "M"),
        ("tiles.rows", tiles.rows, "P"),
        ("tiles.offsets", tiles.offsets, (rows * columns + 1,)),
    )
    if means2d.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"means2d: expected float32 or float64, got {means2d.dtype}; convert the Gaussians with .to()")
    if background is None:
        background = features.new_zeros(features.shape[1])
    values = means2d, conics, opacities, features, background
    for name, value in zip(Splats._fields[1:5], values[1:], strict=True):
        _check_alike(name, value, means2d)
    again = "bin the tiles again from these Gaussians"
    _check_rows("tiles.rows", tiles.rows, means2d, f"M = {len(means2d)} (from means2d)", again)
    if index is not None:
        advice = "pass Projected.index of these Gaussians"
        _check_rows("index", index, features, f"N = {len(features)} (from features)", advice)
        index = index.contiguous()
    offsets, pairs = tiles.offsets, len(tiles.rows)
    if offsets.dtype not in (torch.int32, torch.int64):
        raise ValueError(f"tiles.offsets: expected int32 or int64, got {offsets.dtype}; {again}")
    ends = (int(offsets[0]), int(offsets[-1])) if offsets.device.type == "cpu" else (0, pairs)
    if ends[0] != 0 or ends[1] > pairs or (offsets.device.type == "cpu" and bool((np.diff(offsets.numpy()) < 0).any())):
        raise ValueError(
            f"tiles.offsets: expected numbers that rise from 0 to at most P = {pairs} (from tiles.rows), got "
            f"{offsets[:8].tolist()} ... {ends[1]}; {again}"
        )
    tiles = tiles._replace(rows=tiles.rows.contiguous(), offsets=offsets.contiguous())
    means2d, conics, opacities, features, background = [value.contiguous() for value in values]
    return Splats(means2d, conics, opacities, features, background, index), tiles


def _check_alike(name: str, value: Tensor, means2d: Tensor) -> None:
    if value.dtype != means2d.dtype or value.device != means2d.device:
        raise ValueError(
            f"{name}: expected {means2d.dtype} on {means2d.device} (from means2d), got {value.dtype} on "
            f"{value.device}; convert it with .to(means2d)"
        )


def _check_rows(name: str, value: Tensor, source: Tensor, count: str, advice: str) -> None:
    """Refuse rows beyond those of `source`; on a GPU the check would cost a wait."""
    if value.dtype not in (torch.int32, torch.int64) or value.device != source.device:
        raise ValueError(
            f"{name}: expected int32 or int64 on {source.device}, got {value.dtype} on {value.device}; {advice}"
        )
    if value.device.type == "cpu" and len(value):
        low, high = int(value.numpy().min()), int(value.numpy().max())  # torch's threads would hang in a forked child
        if low < 0 or high >= len(source):
            raise ValueError(f"{name}: expected rows from 0 to below {count}, got {low if low < 0 else high}; {advice}")


def check_sizes(width: int, height: int, tile_size: int, prefix: str = "") -> None:
    """Raise a ValueError unless the sizes of an image and of its tiles are whole numbers of pixels, at least 1."""
    for name, size in (("width", width), ("height", height), ("tile_size", tile_size)):
        check_whole(prefix + name, size, 1)
