"""What the compiled kernels do with one cell: a rectangle of pixels that is worked on as flat, contiguous arrays.

A tile is cut into cells of CELL_WIDTH x CELL_HEIGHT pixels. Pixel (i, j) of a cell is entry p = i * CELL_WIDTH + j of a
*plane* of PIXELS entries, and the image rows of a cell that a Gaussian's ellipse touches are one run [start, stop) of p.
Every inner loop goes along such a run, without branches, over planes at constant distances from each other: that is
what lets LLVM compute 8 or 16 pixels per instruction. `max(start, 0)` tells it that indices do not wrap around.

Two kinds of scratch arrays, both of the dtype of the data: `state`, the planes named below, and stacks of planes, one
per channel (`colors`, `grads`) or one per Gaussian of the CHUNK being worked on (`weights`, `ratios`, `slopes`).
"""

from __future__ import annotations

import math
from typing import Any

from numba import njit

from .contract import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from .numba_exp import exp_negative

CELL_WIDTH, CELL_HEIGHT = 8, 16  # narrower than high: less of the run lies outside of the ellipse
PIXELS = CELL_WIDTH * CELL_HEIGHT
CHUNK = 16  # Gaussians per pass over the channels: their weights stay in the first-level cache
X, Y, LIGHT, BEHIND, SHARE = 0, PIXELS, 2 * PIXELS, 3 * PIXELS, 4 * PIXELS
"""Planes of `state`: the pixel's centre; its transmittance T, negative once it has stopped; in the backward pass, the
loss that comes from what is still behind; and the slope of the loss that a weight has apart from its features."""
STATE = 5 * PIXELS

PLAIN = {"contract", "nsz"}  # a * b + c in one instruction
SUMS = {"contract", "nsz", "reassoc"}  # sums in another order, which is always the same one
OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}


@njit(fastmath=PLAIN, **OPTIONS)
def start_cell(state: Any, left: int, top: int, right: int, bottom: int) -> None:
    """Place the pixel centres; pixels at or beyond (right, bottom), the image's border, count as stopped."""
    one = state.dtype.type(1)
    half = state.dtype.type(0.5)
    for i in range(CELL_HEIGHT):
        for j in range(CELL_WIDTH):
            p = i * CELL_WIDTH + j
            state[X + p] = left + j + half
            state[Y + p] = top + i + half
            state[LIGHT + p] = one if top + i < bottom and left + j < right else -one


@njit(fastmath=PLAIN, **OPTIONS)
def any_light(state: Any) -> bool:
    """Whether some pixel of the cell has not stopped."""
    most = state[LIGHT]
    for p in range(PIXELS):
        most = max(most, state[LIGHT + p])
    return most > 0


@njit(fastmath=PLAIN, **OPTIONS)
def find_run(ellipses: Any, row: int, left: int, top: int, rows: int, slack: float) -> tuple[int, int]:
    """The run of pixels whose image rows meet the ellipse alpha >= ALPHA_MIN within the cell; (0, 0) if none does.

    The ellipse is a x^2 + 2 b x y + c y^2 = reach about the mean. Where its highest point lies beside the cell, the
    highest point within the cell is on the nearer side. The lowest point mirrors it. All in float64.

    Args:
        ellipses: [M, 8] float64: mean (x, y), conic (a, b, c), reach, determinant a c - b^2 (not positive: any
            pixel may be touched), and x of the highest point for reach 1.
        row: which Gaussian.
        left: first pixel column of the cell.
        top: first pixel row of the cell.
        rows: how many rows of the cell lie in the image.
        slack: relative rounding error of the power of the density as it is computed for each pixel.
    """
    a, b, c = ellipses[row, 2], ellipses[row, 3], ellipses[row, 4]
    reach, determinant = ellipses[row, 5], ellipses[row, 6]
    if not reach > 0:
        return 0, 0
    if not determinant > 0:
        return 0, CELL_WIDTH * rows
    x_low, y_low = left + 0.5 - ellipses[row, 0], top + 0.5 - ellipses[row, 1]
    x_high, y_high = x_low + (CELL_WIDTH - 1), y_low + (CELL_HEIGHT - 1)
    # The terms of the form are largest, and cancel worst, in the far corner.
    x_far, y_far = max(-x_low, x_high), max(-y_low, y_high)
    reach += slack * (a * x_far * x_far + 2 * abs(b) * x_far * y_far + c * y_far * y_far + reach + 1)
    lean = ellipses[row, 7] * math.sqrt(reach)
    x_up, x_down = min(max(lean, x_low), x_high), min(max(-lean, x_low), x_high)
    up, down = c * reach - x_up * x_up * determinant, c * reach - x_down * x_down * determinant
    margin = slack * (y_far + 1)
    y_up = (math.sqrt(max(up, 0.0)) - b * x_up) / c + margin - y_low  # in rows of the cell
    y_down = (-math.sqrt(max(down, 0.0)) - b * x_down) / c - margin - y_low
    if not (max(up, down) >= 0 and y_up >= 0 and y_down <= rows - 1):  # NaN touches nothing
        return 0, 0
    first = rows - int(rows - max(y_down, 0.0))  # rounded up, and below down
    return CELL_WIDTH * first, CELL_WIDTH * int(min(y_up + 1, float(rows)))


@njit(fastmath=PLAIN, **OPTIONS)
def weigh(
    state: Any, weights: Any, ratios: Any, plane: int, run: tuple[int, int], splat: tuple[Any, Any, Any, Any, Any, Any]
) -> None:
    """Composite one Gaussian into the transmittance: weight = alpha T where it is drawn, 0 elsewhere.

    Also keeps ratio = alpha / (1 - alpha), which the backward pass needs, as 0 where alpha has no gradient.

    Args:
        state: planes X, Y and LIGHT; LIGHT is updated.
        weights: stack whose plane `plane` is written along the run.
        ratios: likewise, or the same array if no ratio is wanted.
        plane: offset of the Gaussian's plane.
        run: pixels the Gaussian touches.
        splat: mean (x, y), conic (a, b, c), opacity.
    """
    mean_x, mean_y, a, b, c, opacity = splat
    one, none = state.dtype.type(1), state.dtype.type(0)
    minus_half = state.dtype.type(-0.5)
    most, least, end = state.dtype.type(ALPHA_MAX), state.dtype.type(ALPHA_MIN), state.dtype.type(TRANSMITTANCE_MIN)
    xx, xy, yy = minus_half * a, -b, minus_half * c
    start = max(run[0], 0)
    at = max(plane, 0) + start
    for i in range(run[1] - start):
        p = start + i
        dx, dy = state[X + p] - mean_x, state[Y + p] - mean_y
        full = opacity * exp_negative(dx * (xx * dx + xy * dy) + yy * dy * dy)
        alpha = min(full, most) if full >= least else none
        light = state[LIGHT + p]
        left = light * (one - alpha)
        drawn = left >= end  # never of a stopped pixel: its light is negative
        state[LIGHT + p] = left if drawn else -abs(light)
        ratios[at + i] = alpha / (one - alpha) if drawn and full <= most else none
        weights[at + i] = alpha * light if drawn else none


@njit(fastmath=PLAIN, **OPTIONS)
def add_colors(colors: Any, weights: Any, features: Any, which: Any, starts: Any, stops: Any, count: int) -> None:
    """colors[c, p] += sum_k weights[k, p] features[which[k], c], over the runs of `count` Gaussians."""
    channels = features.shape[1]
    for c in range(0, channels - 3, 4):
        for k in range(count):
            row, start = which[k], max(starts[k], 0)
            f0, f1, f2, f3 = features[row, c], features[row, c + 1], features[row, c + 2], features[row, c + 3]
            into, weight = max(c * PIXELS + start, 0), max(k * PIXELS + start, 0)
            for i in range(stops[k] - start):
                w = weights[weight + i]
                colors[into + i] += f0 * w
                colors[into + PIXELS + i] += f1 * w
                colors[into + 2 * PIXELS + i] += f2 * w
                colors[into + 3 * PIXELS + i] += f3 * w
    for c in range(channels - channels % 4, channels):
        for k in range(count):
            f, start = features[which[k], c], max(starts[k], 0)
            into, weight = max(c * PIXELS + start, 0), max(k * PIXELS + start, 0)
            for i in range(stops[k] - start):
                colors[into + i] += f * weights[weight + i]


@njit(fastmath=PLAIN, **OPTIONS)
def find_slopes(
    slopes: Any, state: Any, grads: Any, features: Any, which: Any, starts: Any, stops: Any, count: int
) -> None:
    """slopes[k, p] = SHARE[p] + sum_c features[which[k], c] grads[c, p]: the loss's slope in the weight of k at p."""
    channels = features.shape[1]
    for k in range(count):
        start = max(starts[k], 0)
        into = max(k * PIXELS + start, 0)
        for i in range(stops[k] - start):
            slopes[into + i] = state[SHARE + start + i]
    for c in range(0, channels - 3, 4):
        for k in range(count):
            row, start = which[k], max(starts[k], 0)
            f0, f1, f2, f3 = features[row, c], features[row, c + 1], features[row, c + 2], features[row, c + 3]
            into, grad = max(k * PIXELS + start, 0), max(c * PIXELS + start, 0)
            for i in range(stops[k] - start):
                slopes[into + i] += (
                    f0 * grads[grad + i]
                    + f1 * grads[grad + PIXELS + i]
                    + f2 * grads[grad + 2 * PIXELS + i]
                    + f3 * grads[grad + 3 * PIXELS + i]
                )
    for c in range(channels - channels % 4, channels):
        for k in range(count):
            f, start = features[which[k], c], max(starts[k], 0)
            into, grad = max(k * PIXELS + start, 0), max(c * PIXELS + start, 0)
            for i in range(stops[k] - start):
                slopes[into + i] += f * grads[grad + i]


@njit(fastmath=SUMS, **OPTIONS)
def sum_moments(
    state: Any, weights: Any, ratios: Any, slopes: Any, plane: int, run: tuple[int, int], mean_x: Any, mean_y: Any
) -> tuple[Any, Any, Any, Any, Any, Any]:
    """Take one Gaussian out of what is behind, and sum v, v dx, v dy, v dx^2, v dx dy, v dy^2 over its pixels.

    v is the loss's slope in log(alpha): weight * slope, less alpha / (1 - alpha) times the loss from all that is behind.
    """
    none = state.dtype.type(0)
    v_1, v_x, v_y, v_xx, v_xy, v_yy = none, none, none, none, none, none
    start = max(run[0], 0)
    at = max(plane, 0) + start
    for i in range(run[1] - start):
        p = start + i
        own = weights[at + i] * slopes[at + i]
        behind = state[BEHIND + p] - own
        state[BEHIND + p] = behind
        ratio = ratios[at + i]
        v = own - ratio * behind if ratio > none else none
        dx, dy = state[X + p] - mean_x, state[Y + p] - mean_y
        v_dx, v_dy = v * dx, v * dy
        v_1 += v
        v_x += v_dx
        v_y += v_dy
        v_xx += v_dx * dx
        v_xy += v_dx * dy
        v_yy += v_dy * dy
    return v_1, v_x, v_y, v_xx, v_xy, v_yy


@njit(fastmath=SUMS, **OPTIONS)
def sum_features(
    out: Any, first: int, slots: Any, weights: Any, grads: Any, which: Any, starts: Any, stops: Any, count: int
) -> None:
    """out[slots[which[k]], first + c] += sum_p weights[k, p] grads[c, p], over the runs of `count` Gaussians."""
    channels = out.shape[1] - first
    none = out.dtype.type(0)
    for c in range(0, channels - 3, 4):
        for k in range(count):
            start = max(starts[k], 0)
            grad, weight = max(c * PIXELS + start, 0), max(k * PIXELS + start, 0)
            s0, s1, s2, s3 = none, none, none, none
            for i in range(stops[k] - start):
                w = weights[weight + i]
                s0 += w * grads[grad + i]
                s1 += w * grads[grad + PIXELS + i]
                s2 += w * grads[grad + 2 * PIXELS + i]
                s3 += w * grads[grad + 3 * PIXELS + i]
            slot = slots[which[k]]
            out[slot, first + c] += s0
            out[slot, first + c + 1] += s1
            out[slot, first + c + 2] += s2
            out[slot, first + c + 3] += s3
    for c in range(channels - channels % 4, channels):
        for k in range(count):
            start = max(starts[k], 0)
            grad, weight = max(c * PIXELS + start, 0), max(k * PIXELS + start, 0)
            s0 = none
            for i in range(stops[k] - start):
                s0 += weights[weight + i] * grads[grad + i]
            out[slots[which[k]], first + c] += s0
