"""The compositing engines: one table, one call."""

from __future__ import annotations

import torch
from torch import Tensor

from ..._check import check_shapes, check_whole
from . import ops
from .contract import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN, Ranked, Splats, Tiles
from .cpu.memory import free_memory
from .ops import check_values
from .table import available_engines, choose, load, offers

__all__ = [
    "ALPHA_MAX",
    "ALPHA_MIN",
    "TRANSMITTANCE_MIN",
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
        The composited features and the opacity of every pixel, differentiable in all tensors but `tiles`.

    Raises:
        ValueError: if shapes, dtypes or devices disagree, `tiles` or `index` belong to other Gaussians, or the engine is
            unknown or does not know the device or the dtype.
        ImportError: if the named engine's package is missing.
        NotImplementedError: at the gradient of a gradient of a compiled engine.

    Note:
        On the CPU, large arrays are kept for the next frames, up to 1 GiB per thread; `free_memory` frees them.
    """
    _check_splats(means2d, conics, opacities, features, tiles, background, index)
    name = choose(engine, means2d.device.type, means2d.dtype)
    splats, tiles = _splats(means2d, conics, opacities, features, background, index), _contiguous(tiles)
    means2d, features = splats.means2d, splats.features
    if offers(name, "composite"):  # differentiable as it stands
        check_values(len(means2d), len(features), index, tiles)
        return load(name).composite(splats, tiles)
    maps, alphas, _ = ops.composite(*splats, *tiles, name)
    return maps, alphas


def rank_channels(
    means2d: Tensor,  # [M, 2]
    conics: Tensor,  # [M, 3]
    opacities: Tensor,  # [M]
    features: Tensor,  # [N, D]
    tiles: Tiles,
    *,
    top: int = 1,
    early: bool = False,
    index: Tensor | None = None,  # [M] int64
    engine: str = "auto",
) -> Ranked:
    """The channels with the largest composited values at each pixel: `composite` and arg-max in one kernel.

    The maps [H, W, D] never reach memory. If features are scores of classes, the result is a label map. It carries no
    gradient.

    Args:
        means2d: as in `composite`.
        conics: as in `composite`.
        opacities: as in `composite`.
        features: finite scores; any number of channels from 1.
        tiles: from `bin_tiles` on the same Gaussians.
        top: how many channels are kept, from 1 to D.
        early: for labels alone, in about two thirds of the time: with `top` 1 an engine may stop at a pixel as soon as its
            label is certain. Its score and opacity are then those reached so far. The CPU engine does so for D up to 26.
        index: as in `composite`.
        engine: as in `composite`. An engine without this kernel composites maps and sorts them.

    Returns:
        Channels, the best first (of equal ones the lowest first), their values, and the opacity; -1 and 0 where nothing
        was drawn.

    Raises:
        ValueError: as `composite`, and if `top` is out of range.
    """
    _check_splats(means2d, conics, opacities, features, tiles, None, index)
    if not torch.compiler.is_compiling():
        check_whole("top", top, 1, features.shape[1])
    name = choose(engine, means2d.device.type, means2d.dtype)
    with torch.no_grad():
        if offers(name, "rank"):
            splats = _splats(means2d.detach(), conics.detach(), opacities.detach(), features.detach(), None, index)
            return Ranked(*ops.rank(*splats, *_contiguous(tiles), top, early, name))
        return Ranked.of_map(*composite(means2d, conics, opacities, features, tiles, index=index, engine=name), top)


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
        means2d: as in `composite`.
        conics: as in `composite`.
        opacities: as in `composite`.
        pixels: one signal per pixel, any number of channels.
        tiles: from `bin_tiles` on the same Gaussians.
        engine: as in `composite`.

    Returns:
        The sums, and the sum of each Gaussian's weights: divide by it for a mean.

    Raises:
        ValueError: as `composite`, and if `pixels` is not as large as the image of `tiles`.
    """
    check_sizes(*tiles[2:], prefix="tiles.")
    check_shapes(
        ("means2d", means2d, "M 2"),
        ("conics", conics, "M 3"),
        ("opacities", opacities, "M"),
        ("pixels", pixels, (tiles.height, tiles.width, "D")),
    )
    _check_kinds({"conics": conics, "opacities": opacities, "pixels": pixels}, means2d)
    _check_tiles(tiles, means2d)
    name = choose(engine, means2d.device.type, means2d.dtype)
    values = (value.detach().contiguous() for value in (means2d, conics, opacities, pixels))
    tiles = _contiguous(tiles)
    if offers(name, "composite"):  # its results are parts of one tensor, which an operator's must not be
        check_values(len(means2d), len(means2d), None, tiles)
        return load(name).accumulate(*values, tiles)
    return ops.accumulate(*values, *tiles, name)


def _check_splats(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    features: Tensor,
    tiles: Tiles,
    background: Tensor | None,
    index: Tensor | None,
) -> None:
    check_shapes(
        ("means2d", means2d, "M 2"),
        ("conics", conics, "M 3"),
        ("opacities", opacities, "M"),
        ("features", features, "M D" if index is None else "N D"),
        ("background", background, "D"),
        ("index", index, "M"),
    )
    _check_kinds({"conics": conics, "opacities": opacities, "features": features, "background": background}, means2d)
    _check_integers("index", index, means2d, (torch.int64,), "pass Projected.index")
    _check_tiles(tiles, means2d)


def _splats(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    features: Tensor,
    background: Tensor | None,
    index: Tensor | None,
) -> Splats:
    if background is None:
        background = features.new_zeros(features.shape[1])
    values = (value.contiguous() for value in (means2d, conics, opacities, features, background))
    means2d, conics, opacities, features, background = values
    return Splats(means2d, conics, opacities, features, background, None if index is None else index.contiguous())


def _contiguous(tiles: Tiles) -> Tiles:
    return tiles._replace(rows=tiles.rows.contiguous(), offsets=tiles.offsets.contiguous())


def _check_kinds(others: dict[str, Tensor | None], means2d: Tensor) -> None:
    for name, value in ({"means2d": means2d} | others).items():
        if not isinstance(value, Tensor) and (value is not None or name != "background"):
            raise TypeError(f"{name}: expected a tensor, got {type(value).__name__}; convert it with torch.as_tensor")
    if means2d.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"means2d: expected float32 or float64, got {means2d.dtype}; convert the Gaussians with .to()")
    for name, value in others.items():
        if value is not None and (value.dtype != means2d.dtype or value.device != means2d.device):
            raise ValueError(
                f"{name}: expected {means2d.dtype} on {means2d.device} (from means2d), got {value.dtype} on "
                f"{value.device}; convert it with .to(means2d)"
            )


def _check_integers(
    name: str, value: Tensor | None, means2d: Tensor, dtypes: tuple[torch.dtype, ...], advice: str
) -> None:
    if not isinstance(value, Tensor | None):
        raise TypeError(f"{name}: expected a tensor, got {type(value).__name__}; {advice}")
    if value is not None and value.device != means2d.device:
        raise ValueError(f"{name}: expected it on {means2d.device} (from means2d), got {value.device}; {advice}")
    if value is not None and value.dtype not in dtypes:
        kinds = " or ".join(str(dtype).removeprefix("torch.") for dtype in dtypes)
        raise ValueError(f"{name}: expected {kinds}, got {value.dtype}; {advice}")


def check_sizes(width: int, height: int, tile_size: int, prefix: str = "") -> None:
    """Raise a ValueError unless the sizes of an image and of its tiles are whole numbers of pixels, at least 1."""
    for name, size in (("width", width), ("height", height), ("tile_size", tile_size)):
        if not isinstance(size, torch.SymInt) and not torch.compiler.is_compiling():  # a traced size has no value yet
            check_whole(prefix + name, size, 1)


def _check_tiles(tiles: Tiles, means2d: Tensor) -> None:
    check_sizes(*tiles[2:], prefix="tiles.")
    rows, columns = tiles.grid
    check_shapes(("tiles.rows", tiles.rows, "P"), ("tiles.offsets", tiles.offsets, (rows * columns + 1,)))
    for name, value in (("rows", tiles.rows), ("offsets", tiles.offsets)):
        _check_integers(f"tiles.{name}", value, means2d, (torch.int32, torch.int64), "bin the tiles again")
