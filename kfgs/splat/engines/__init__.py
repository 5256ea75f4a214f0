"""The compositing engines: one table, one call."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from ..._check import check_choice, check_shapes
from .contract import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

if TYPE_CHECKING:
    from ..tiles import Tiles

__all__ = [
    "ALPHA_MAX",
    "ALPHA_MIN",
    "TRANSMITTANCE_MIN",
    "accumulate_pixels",
    "available_engines",
    "composite",
]


class _Entry(NamedTuple):
    module: str
    needs: str  # the package it imports
    install: str  # how to get that
    devices: tuple[str, ...]


_ENGINES = {
    "numba": _Entry("kfgs.splat.engines.numba_cpu", "numba", "pip install numba", ("cpu",)),
    "reference": _Entry("kfgs.splat.engines.reference", "torch", "pip install torch", ("cpu", "cuda")),
}
"""In order of preference: `engine="auto"` takes the first that knows the device and can be imported."""

Composite = Callable[[Tensor, Tensor, Tensor, Tensor, "Tiles", Tensor | None], tuple[Tensor, Tensor]]


def available_engines() -> list[str]:
    """Names of the engines whose packages are installed, fastest first; nothing is imported to find out."""
    return [name for name, entry in _ENGINES.items() if find_spec(entry.needs) and find_spec(entry.module)]


def composite(
    means2d: Tensor,  # [M, 2] pixels (x, y)
    conics: Tensor,  # [M, 3] (a, b, c)
    opacities: Tensor,  # [M]
    features: Tensor,  # [M, D]
    tiles: Tiles,
    *,
    background: Tensor | None = None,  # [D]
    engine: str = "auto",
) -> tuple[Tensor, Tensor]:  # maps [H, W, D], alphas [H, W]
    """Composite the projected Gaussians of each tile front to back (Eq. 1-2 of 3DGS, for any number of channels).

    What every engine promises is written in `kfgs.splat.engines.contract`.

    Args:
        means2d: centres; the centre of the first pixel is (0.5, 0.5).
        conics: inverse 2-D covariances.
        opacities: in (0, 1).
        features: what is composited; any number of channels from 1.
        tiles: from `bin_tiles` on the same Gaussians.
        background: what shows through, zeros if None.
        engine: a name of `available_engines()`, or "auto": the fastest one for the tensors' device.

    Returns:
        The composited features and the opacity of every pixel, differentiable in all tensors but `tiles`.

    Raises:
        ValueError: if shapes, dtypes or devices disagree, `tiles` is of other Gaussians, or the engine is unknown or
            does not run on the device.
        ImportError: if the named engine's package is missing.
    """
    check_shapes(
        ("means2d", means2d, "M 2"),
        ("conics", conics, "M 3"),
        ("opacities", opacities, "M"),
        ("features", features, "M D"),
        ("background", background, "D"),
    )
    _check_kinds({"conics": conics, "opacities": opacities, "features": features, "background": background}, means2d)
    _check_tiles(tiles, means2d)
    run = _load_auto(means2d.device.type) if engine == "auto" else _load_named(engine, means2d.device.type)
    background = background if background is None else background.contiguous()
    return run(
        means2d.contiguous(), conics.contiguous(), opacities.contiguous(), features.contiguous(), tiles, background
    )


def accumulate_pixels(
    means2d: Tensor,  # [M, 2]
    conics: Tensor,  # [M, 3]
    opacities: Tensor,  # [M]
    pixels: Tensor,  # [H, W, D]
    tiles: Tiles,
    *,
    engine: str = "auto",
) -> Tensor:  # [M, D]
    """Sum per-pixel values into the Gaussians, each weighted by how much the Gaussian shows at the pixel.

    This is weights^T · pixels, the adjoint of `composite` in `features`, and what uplifting features without training,
    visibility counts (`pixels` of ones) and pruning by importance need. The result carries no gradient.

    Args:
        means2d: as in `composite`.
        conics: as in `composite`.
        opacities: as in `composite`.
        pixels: one signal per pixel, any number of channels.
        tiles: from `bin_tiles` on the same Gaussians.
        engine: as in `composite`.

    Raises:
        ValueError: as `composite`, and if `pixels` is not as large as the image of `tiles`.
    """
    D = check_shapes(("pixels", pixels, f"{tiles.height} {tiles.width} D"))["D"]
    with torch.inference_mode(False), torch.enable_grad():
        features = torch.zeros(len(means2d), D, dtype=pixels.dtype, device=pixels.device, requires_grad=True)
        splats = _recorded(means2d), _recorded(conics), _recorded(opacities)
        tiles = tiles._replace(rows=_recorded(tiles.rows), offsets=_recorded(tiles.offsets))
        maps, _ = composite(*splats, features, tiles, engine=engine)
        return torch.autograd.grad(maps, features, _recorded(pixels))[0]


def _recorded(value: Tensor) -> Tensor:
    """The tensor without a history, such that autograd can work with it: one made in inference mode is copied."""
    return value.clone() if value.is_inference() else value.detach()


def _check_kinds(others: dict[str, Tensor | None], means2d: Tensor) -> None:
    if means2d.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"means2d: expected float32 or float64, got {means2d.dtype}; convert the Gaussians with .to()")
    for name, value in others.items():
        if value is not None and (value.dtype != means2d.dtype or value.device != means2d.device):
            raise ValueError(
                f"{name}: expected {means2d.dtype} on {means2d.device} (from means2d), got {value.dtype} on "
                f"{value.device}; convert it with .to(means2d)"
            )


def _check_tiles(tiles: Tiles, means2d: Tensor) -> None:
    rows, columns = tiles.grid
    check_shapes(("tiles.rows", tiles.rows, "P"), ("tiles.offsets", tiles.offsets, str(rows * columns + 1)))
    again = "bin the tiles again from these Gaussians"
    for name, value in (("rows", tiles.rows), ("offsets", tiles.offsets)):
        if value.device != means2d.device:
            raise ValueError(
                f"tiles.{name}: expected it on {means2d.device} (from means2d), got {value.device}; {again}"
            )
        if value.dtype not in (torch.int32, torch.int64):
            raise ValueError(f"tiles.{name}: expected int32 or int64, got {value.dtype}; {again}")
    # What is wrong here would be read from foreign memory by a compiled engine. On a GPU the check would cost a wait.
    if means2d.device.type != "cpu":
        return
    if len(tiles.rows):
        low, high = (int(end) for end in torch.aminmax(tiles.rows))
        if low < 0 or high >= len(means2d):
            wrong = low if low < 0 else high
            raise ValueError(
                f"tiles.rows: expected rows from 0 to below M = {len(means2d)} (from means2d), got {wrong}; {again}"
            )
    ends = int(tiles.offsets[0]), int(tiles.offsets[-1])
    if ends != (0, len(tiles.rows)) or bool((tiles.offsets.diff() < 0).any()):
        raise ValueError(
            f"tiles.offsets: expected numbers that rise from 0 to P = {len(tiles.rows)} (from tiles.rows), got "
            f"{tiles.offsets[:8].tolist()} ... {ends[1]}; {again}"
        )


@cache
def _load(name: str) -> Composite:
    entry = _ENGINES[name]
    try:
        return import_module(entry.module).composite
    except ImportError as error:
        raise ImportError(
            f"engine: expected {entry.needs} for engine {name!r}, but it cannot be imported ({error}); "
            f"install it with `{entry.install}`, or choose one of {available_engines()}"
        ) from error


def _load_named(name: str, device: str) -> Composite:
    check_choice("engine", name, ["auto", *_ENGINES])
    if device not in _ENGINES[name].devices:
        raise ValueError(
            f"engine: expected one that runs on {device} (from means2d), got {name!r} for "
            f"{', '.join(_ENGINES[name].devices)}; use engine='auto'"
        )
    return _load(name)


def _load_auto(device: str) -> Composite:
    for name, entry in _ENGINES.items():
        if device in entry.devices and name in available_engines():
            try:
                return _load(name)
            except ImportError:  # installed, but broken on this machine
                continue
    return _load("reference")  # pure torch: runs wherever torch does
