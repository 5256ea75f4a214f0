"""The Triton kernel of the backward pass: the layout of `kernels`, front to back again.

With G the gradient of a pixel's maps and g that of its alpha, the loss's slope in the weight of Gaussian k is
D_k = f_k · G + g, and all that is composited adds up to R = maps · G + alpha g. So walking front to back, what lies
behind k is R less the w D up to k, and with alpha_k = opacity_k * density_k,

    v_k = alpha_k dL/dalpha_k = w_k D_k - alpha_k / (1 - alpha_k) (R - sum_{j <= k} w_j D_j)

is the slope in log(alpha_k), from which the gradients of centre, conic and opacity are six sums over the pixels.
"""

# mypy: disable-error-code="no-untyped-def"

import triton
import triton.language as tl

from .kernels import (
    MOST,
    SIZES,
    add_block,
    find_alphas,
    find_features,
    find_list,
    load_block,
    load_splats,
    place_pixels,
    sum_pixels,
)


@triton.jit
def find_total(maps, grad_maps, pixel, inside, channels, PIXELS: tl.constexpr, BLOCK: tl.constexpr):
    """The product maps · grad_maps over all channels: [PIXELS]."""
    total = tl.zeros((PIXELS,), tl.float32)
    for start in range(0, channels, BLOCK):
        channel = start + tl.arange(0, BLOCK)
        shown = load_block(maps, pixel, inside, channel, channels)
        total += tl.sum(shown * load_block(grad_maps, pixel, inside, channel, channels), 1)
    return total


@triton.jit
def add_splat_gradients(
    v, x, y, position, count, listed_rows, means2d, conics, opacities,
    grad_means2d, grad_conics, grad_opacities,
):  # fmt: skip
    """Add the slopes v [CHUNK, PIXELS] in log(alpha) to the gradients of the Gaussians at `position` [CHUNK].

    The Gaussians are loaded again: kept since the alphas were found, they would push other registers out to memory.
    """
    row, listed, mean_x, mean_y, a, b, c, opacity = load_splats(
        position, count, listed_rows, means2d, conics, opacities
    )
    dx, dy = x[None, :] - mean_x[:, None], y[None, :] - mean_y[:, None]
    v_dx, v_dy = v * dx, v * dy
    total, total_x, total_y = tl.sum(v, 1), tl.sum(v_dx, 1), tl.sum(v_dy, 1)
    tl.atomic_add(grad_means2d + 2 * row, a * total_x + b * total_y, mask=listed, sem="relaxed")
    tl.atomic_add(grad_means2d + 2 * row + 1, b * total_x + c * total_y, mask=listed, sem="relaxed")
    tl.atomic_add(grad_conics + 3 * row, -0.5 * tl.sum(v_dx * dx, 1), mask=listed, sem="relaxed")
    tl.atomic_add(grad_conics + 3 * row + 1, -tl.sum(v_dx * dy, 1), mask=listed, sem="relaxed")
    tl.atomic_add(grad_conics + 3 * row + 2, -0.5 * tl.sum(v_dy * dy, 1), mask=listed, sem="relaxed")
    per_alpha = 1.0 / tl.where(opacity > 0.0, opacity, 1.0)  # one that is 0 was skipped everywhere
    tl.atomic_add(grad_opacities + row, total * per_alpha, mask=listed, sem="relaxed")


@triton.jit(do_not_specialize=SIZES)
def differentiate_kernel(
    means2d, conics, opacities, features, index, rows, offsets,
    maps, alphas, stops, grad_maps, grad_alphas,
    grad_means2d, grad_conics, grad_opacities, grad_features,
    width, height, columns, channels,
    SIDE: tl.constexpr, PARTS: tl.constexpr, PIXELS: tl.constexpr,
    CHUNK: tl.constexpr, BLOCK: tl.constexpr, PRECISION: tl.constexpr,
    OF_SPLATS: tl.constexpr, OF_FEATURES: tl.constexpr,
):  # fmt: skip
    """Add the gradients that PIXELS pixels give to the Gaussians of their tile, and to the features these show.

    Any number of channels: each chunk goes over them in blocks.
    """
    tile, pixel, x, y, inside = place_pixels(columns, width, height, SIDE, PARTS, PIXELS)
    listed_rows, count = find_list(tile, rows, offsets)
    stop = tl.load(stops + pixel, mask=inside, other=0)
    until = tl.max(stop, 0)
    light = tl.full((PIXELS,), 1.0, tl.float32)
    share = tl.zeros((PIXELS,), tl.float32)
    behind = tl.zeros((PIXELS,), tl.float32)
    if OF_SPLATS:
        share = tl.load(grad_alphas + pixel, mask=inside, other=0.0)
        behind = share * tl.load(alphas + pixel, mask=inside, other=0.0)
        behind += find_total(maps, grad_maps, pixel, inside, channels, PIXELS, BLOCK)
    first = 0
    while first < until:
        position = first + tl.arange(0, CHUNK)
        row, listed, mean_x, mean_y, a, b, c, opacity = load_splats(
            position, count, listed_rows, means2d, conics, opacities
        )
        alpha, full, _, _ = find_alphas(x, y, mean_x, mean_y, a, b, c, opacity)
        alpha = tl.where(position[:, None] < stop[None, :], alpha, 0.0)
        passed = 1.0 - alpha
        left = light[None, :] * tl.cumprod(passed, 0)
        light = tl.minimum(light, tl.min(left, 0))
        odds = alpha / passed
        weight = odds * left
        odds = tl.where(full <= MOST, odds, 0.0)
        shown_row = find_features(row, listed, index)
        slope = tl.zeros((CHUNK, PIXELS), tl.float32) + share[None, :]
        for start in range(0, channels, BLOCK):
            channel = start + tl.arange(0, BLOCK)
            grad = load_block(grad_maps, pixel, inside, channel, channels)
            if OF_SPLATS:
                shown = load_block(features, shown_row, listed, channel, channels)
                slope = tl.dot(shown, tl.trans(grad), slope, input_precision=PRECISION)
            if OF_FEATURES:
                if BLOCK > 16:
                    part = tl.dot(weight, grad, input_precision=PRECISION)
                else:
                    part = sum_pixels(weight, grad, CHUNK, PIXELS, BLOCK, PRECISION)
                add_block(grad_features, shown_row, listed, channel, channels, part)
        if OF_SPLATS:
            own = weight * slope
            rest = behind[None, :] - tl.cumsum(own, 0)
            behind -= tl.sum(own, 0)
            v = tl.where(odds > 0.0, own - odds * rest, 0.0)
            add_splat_gradients(
                v, x, y, position, count, listed_rows, means2d, conics, opacities,
                grad_means2d, grad_conics, grad_opacities,
            )  # fmt: skip
        first += CHUNK
