"""The engines as operators of torch: what autograd, `torch.compile` and `torch.export` see of them.

An engine's functions become opaque operators with backward passes, and with fake kernels that give the shapes. Importing
`kfgs.splat` registers them; an exported program needs that. torch demands flat schemas.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.library import register_autograd, register_fake

from .contract import Cloud, Composited, Pinhole, Ranked, Splats, Tiles
from .table import load

SPLATS = "Tensor means2d, Tensor conics, Tensor opacities, Tensor features, Tensor background, Tensor? index"
TILES = "Tensor rows, Tensor offsets, SymInt width, SymInt height, SymInt tile_size"
CLOUD = "Tensor means, Tensor quats, Tensor scales, Tensor opacities"
PINHOLE = "Tensor viewmat, Tensor K, SymInt width, SymInt height, float near, float low_pass"
"""The fields of the contract's tuples, as schemas name them. The functions below get them flat, in this order."""


def _operator(schema: str) -> Callable[[Callable[..., Any]], Any]:
    """The function as `torch.ops.kfgs.<its name>`. torch.library.custom_op would import the compiler, for a second."""

    def define(function: Callable[..., Any]) -> Any:
        name = function.__name__
        torch.library.define(f"kfgs::{name}", schema)
        torch.library.impl(f"kfgs::{name}", "default", function)
        return getattr(torch.ops.kfgs, name).default

    return define


def _refuse(ctx: Any, *grads: Tensor) -> None:
    """The gradient of a backward pass: an error."""
    raise NotImplementedError(
        "backward: expected one of first order, got the gradient of a gradient, which compiled engines do not have; "
        "leave out create_graph=True (project(..., engine='reference') has second derivatives, composite has not)"
    )


def check_values(count: int, sources: int, index: Tensor | None, tiles: Tiles) -> None:
    """Refuse numbers with which a compiled engine would read foreign memory; on a GPU the check would cost a wait.

    Raises:
        ValueError: if `index` or `rows` point beyond what there is, or `offsets` do not rise from 0 to P.
    """
    rows, offsets = tiles.rows, tiles.offsets
    if rows.device.type != "cpu":
        return
    again = "bin the tiles again from these Gaussians"
    for name, value, below, origin, advice in (
        ("tiles.rows", rows, count, "M", again),
        ("index", index, sources, "N", "pass Projected.index of these Gaussians"),
    ):
        if value is None or len(value) == 0:
            continue
        low, high = int(value.numpy().min()), int(value.numpy().max())  # torch's threads would hang in a forked child
        if low < 0 or high >= below:
            source = "means2d" if origin == "M" else "features"
            raise ValueError(
                f"{name}: expected rows from 0 to below {origin} = {below} (from {source}), "
                f"got {low if low < 0 else high}; {advice}"
            )
    ends = int(offsets[0]), int(offsets[-1])
    if ends != (0, len(rows)) or bool((np.diff(offsets.numpy()) < 0).any()):
        raise ValueError(
            f"tiles.offsets: expected numbers that rise from 0 to P = {len(rows)} (from tiles.rows), got "
            f"{offsets[:8].tolist()} ... {ends[1]}; {again}"
        )


@_operator(f"({SPLATS}, {TILES}, str engine) -> (Tensor, Tensor, Tensor)")
def composite(*inputs: Any) -> Composited:
    """Maps, alphas and the engine's trace, see `kfgs.splat.engines.composite`."""
    splats, tiles = Splats(*inputs[:6]), Tiles(*inputs[6:11])
    check_values(len(splats.means2d), len(splats.features), splats.index, tiles)
    return load(inputs[11]).forward(splats, tiles)


@register_fake("kfgs::composite")
def _(*inputs: Any) -> tuple[Tensor, Tensor, Tensor]:
    features, tiles = inputs[3], Tiles(*inputs[6:11])
    maps = features.new_empty(tiles.height, tiles.width, features.shape[1])
    trace = tiles.rows.new_empty(torch.library.get_ctx().new_dynamic_size(), dtype=torch.int32)
    return maps, features.new_empty(tiles.height, tiles.width), trace


@_operator(
    f"(Tensor grad_maps, Tensor grad_alphas, bool[] wanted, {SPLATS}, {TILES}, "
    "Tensor maps, Tensor alphas, Tensor trace, str engine) -> Tensor[]"
)
def composite_backward(grad_maps: Tensor, grad_alphas: Tensor, wanted: list[bool], *inputs: Any) -> list[Tensor]:
    """Gradients of the five differentiable inputs, empty where not wanted."""
    splats, tiles, result = Splats(*inputs[:6]), Tiles(*inputs[6:11]), Composited(*inputs[11:14])
    return load(inputs[14]).backward((grad_maps, grad_alphas), wanted, splats, tiles, result)


@register_fake("kfgs::composite_backward")
def _(grad_maps: Tensor, grad_alphas: Tensor, wanted: list[bool], *inputs: Any) -> list[Tensor]:
    return [torch.empty_like(v) if want else v.new_empty(0) for v, want in zip(inputs[:5], wanted, strict=True)]


def _save_composite(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor, Tensor]) -> None:
    *tensors, width, height, tile_size, engine = inputs
    ctx.save_for_backward(*tensors, *output)
    ctx.size, ctx.engine = (width, height, tile_size), engine


def _differentiate_composite(ctx: Any, grad_maps: Tensor, grad_alphas: Tensor, _: Tensor) -> tuple[Any, ...]:
    *inputs, maps, alphas, trace = ctx.saved_tensors
    wanted = list(ctx.needs_input_grad[:5])
    grads = composite_backward(
        grad_maps.contiguous(), grad_alphas.contiguous(), wanted, *inputs, *ctx.size, maps, alphas, trace, ctx.engine
    )
    return *(grad if want else None for grad, want in zip(grads, wanted, strict=True)), *[None] * 7


register_autograd("kfgs::composite", _differentiate_composite, setup_context=_save_composite)


@_operator(f"(Tensor means2d, Tensor conics, Tensor opacities, Tensor pixels, {TILES}, str engine) -> (Tensor, Tensor)")
def accumulate(means2d: Tensor, conics: Tensor, opacities: Tensor, pixels: Tensor, *view: Any) -> tuple[Tensor, Tensor]:
    """Sums and weights, see `kfgs.splat.engines.accumulate_pixels`; without gradient."""
    tiles = Tiles(*view[:5])
    check_values(len(means2d), len(means2d), None, tiles)
    return load(view[5]).accumulate(means2d, conics, opacities, pixels, tiles)


@register_fake("kfgs::accumulate")
def _(means2d: Tensor, conics: Tensor, opacities: Tensor, pixels: Tensor, *view: Any) -> tuple[Tensor, Tensor]:
    return pixels.new_empty(len(means2d), pixels.shape[2]), pixels.new_empty(len(means2d))


@_operator(f"({SPLATS}, {TILES}, SymInt top, bool early, str engine) -> (Tensor, Tensor, Tensor)")
def rank(*inputs: Any) -> Ranked:
    """Labels, scores and alphas, see `kfgs.splat.engines.rank_channels`; without gradient."""
    splats, tiles = Splats(*inputs[:6]), Tiles(*inputs[6:11])
    check_values(len(splats.means2d), len(splats.features), splats.index, tiles)
    return load(inputs[13]).rank(splats, tiles, inputs[11], inputs[12])


@register_fake("kfgs::rank")
def _(*inputs: Any) -> tuple[Tensor, Tensor, Tensor]:
    features, tiles, top = inputs[3], Tiles(*inputs[6:11]), inputs[11]
    scores = features.new_empty(tiles.height, tiles.width, top)
    labels = features.new_empty(tiles.height, tiles.width, top, dtype=torch.int64)
    return labels, scores, features.new_empty(tiles.height, tiles.width)


@_operator(f"({CLOUD}, {PINHOLE}, str engine) -> (Tensor, Tensor, Tensor, Tensor, Tensor, Tensor)")
def project(*inputs: Any) -> tuple[Tensor, ...]:
    """The six tensors of `kfgs.splat.Projected`."""
    return load(inputs[10]).project(Cloud(*inputs[:4]), Pinhole(*inputs[4:10]))


@register_fake("kfgs::project")
def _(means: Tensor, *others: Any) -> tuple[Tensor, ...]:
    M = torch.library.get_ctx().new_dynamic_size()
    floats = (means.new_empty(shape) for shape in ((M, 2), (M, 3), (M,), (M,), (M, 2)))
    return *floats, means.new_empty(M, dtype=torch.int64)


@_operator(
    "(Tensor grad_means2d, Tensor grad_conics, Tensor grad_depths, Tensor grad_opacities, "
    f"{CLOUD}, {PINHOLE}, Tensor index, str engine) -> Tensor[]"
)
def project_backward(*inputs: Any) -> list[Tensor]:
    """Gradients of means, quats, scales and opacities."""
    cloud, pinhole, (index, engine) = Cloud(*inputs[4:8]), Pinhole(*inputs[8:14]), inputs[14:]
    return load(engine).project_backward(inputs[:4], cloud, pinhole, index)


@register_fake("kfgs::project_backward")
def _(*inputs: Any) -> list[Tensor]:
    return [torch.empty_like(value) for value in inputs[4:8]]


def _save_project(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    *ctx.options, ctx.engine = inputs[6:]
    ctx.save_for_backward(*inputs[:6], output[5])


def _differentiate_project(ctx: Any, *grads: Tensor) -> tuple[Any, ...]:
    *inputs, index = ctx.saved_tensors
    given = (grad.contiguous() for grad in grads[:4])
    return *project_backward(*given, *inputs, *ctx.options, index, ctx.engine), *[None] * 7


register_autograd("kfgs::project", _differentiate_project, setup_context=_save_project)


@_operator("(Tensor sh, Tensor means, Tensor center, Tensor index, str engine) -> Tensor")
def shade(sh: Tensor, means: Tensor, center: Tensor, index: Tensor, engine: str) -> Tensor:
    """Colours of the visible Gaussians, as `kfgs.splat.evaluate_sh` has them."""
    return load(engine).shade(sh, means, center, index)


@register_fake("kfgs::shade")
def _(sh: Tensor, means: Tensor, center: Tensor, index: Tensor, engine: str) -> Tensor:
    return sh.new_empty(index.shape[0], 3)


@_operator("(Tensor grad, Tensor sh, Tensor means, Tensor center, Tensor index, str engine) -> Tensor[]")
def shade_backward(grad: Tensor, *inputs: Any) -> list[Tensor]:
    """Gradients of sh and means."""
    return load(inputs[-1]).shade_backward(grad, *inputs[:-1])


@register_fake("kfgs::shade_backward")
def _(grad: Tensor, sh: Tensor, means: Tensor, *others: Any) -> list[Tensor]:
    return [torch.empty_like(sh), torch.empty_like(means)]


def _save_shade(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    *tensors, ctx.engine = inputs
    ctx.save_for_backward(*tensors)


def _differentiate_shade(ctx: Any, grad: Tensor) -> tuple[Any, ...]:
    return *shade_backward(grad.contiguous(), *ctx.saved_tensors, ctx.engine), None, None, None


register_autograd("kfgs::shade", _differentiate_shade, setup_context=_save_shade)


@_operator(
    "(Tensor means2d, Tensor conics, Tensor depths, Tensor opacities, Tensor extents, "
    "SymInt width, SymInt height, SymInt tile_size, str engine) -> (Tensor, Tensor)"
)
def bin_tiles(*inputs: Any) -> tuple[Tensor, Tensor]:
    """Rows and offsets of `kfgs.splat.Tiles`."""
    return load(inputs[-1]).bin(*inputs[:-1])


@register_fake("kfgs::bin_tiles")
def _(*inputs: Any) -> tuple[Tensor, Tensor]:
    means2d, (width, height, tile_size) = inputs[0], inputs[5:8]
    pairs = torch.library.get_ctx().new_dynamic_size()
    tiles = -(-width // tile_size) * -(-height // tile_size)
    return means2d.new_empty(pairs, dtype=torch.int32), means2d.new_empty(tiles + 1, dtype=torch.int64)


for _name in ("composite_backward", "project_backward", "shade_backward"):
    register_autograd(f"kfgs::{_name}", _refuse)
