"""The Triton kernel that composites scores and keeps the best of each pixel, so that no map of all scores is written.

A program has PIXELS pixels, as in `kernels`, and goes through the channels BLOCK at a time, each time from the first
Gaussian on: up to BLOCK channels, that is once. The sums of a block stay in registers. From there the best TOP are taken
out one by one, and put in place of the worst of the best of the blocks before.
"""

# mypy: disable-error-code="no-untyped-def"
# Triton gives the arguments their types when it compiles; only constants are annotated.

import triton
import triton.language as tl

from .kernels import SIZES, find_alphas, find_features, find_list, load_block, load_splats, place_pixels, weigh

NONE = tl.constexpr(2**30)
"""Larger than any channel. It stays where no score is a number: the label is then -1, not an index out of range."""


@triton.jit
def take_best(values, names):
    """The largest of values [PIXELS, n] and its name, of equal ones the lowest; and the values without it."""
    best = tl.max(values, 1)
    name = tl.min(tl.where(values == best[:, None], names, NONE), 1)
    return best, name, tl.where(names == name[:, None], float("-inf"), values)


@triton.jit
def keep_best(value, name, best, named):
    """Put a value [PIXELS] in place of the smallest of `best` [PIXELS, n] if it is larger; of equal ones the last is it."""
    worst = tl.min(best, 1)
    last = tl.max(tl.where(best == worst[:, None], named, -1), 1)
    place = (value > worst)[:, None] & (named == last[:, None])
    return tl.where(place, value[:, None], best), tl.where(place, name[:, None], named)


@triton.jit(do_not_specialize=[*SIZES, "top"])
def rank_kernel(
    means2d, conics, opacities, features, index, rows, offsets,
    labels, scores, alphas,
    width, height, columns, channels, top,
    SIDE: tl.constexpr, PARTS: tl.constexpr, PIXELS: tl.constexpr,
    CHUNK: tl.constexpr, BLOCK: tl.constexpr, TOP: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """The `top` best channels at PIXELS pixels; TOP is the next power of two."""
    tile, pixel, x, y, inside = place_pixels(columns, width, height, SIDE, PARTS, PIXELS)
    listed_rows, count = find_list(tile, rows, offsets)
    light = tl.full((PIXELS,), 1.0, tl.float32)
    rank = tl.arange(0, TOP)[None, :] + tl.zeros((PIXELS, 1), tl.int32)
    best = tl.where(rank < top, float("-inf"), float("inf"))  # places beyond `top` are never the worst
    named = NONE + rank  # no two are equal
    begin = 0
    while begin < channels:
        channel = begin + tl.arange(0, BLOCK)
        light = tl.full((PIXELS,), 1.0, tl.float32)
        stop = tl.where(inside, count, 0)
        sums = tl.zeros((PIXELS, BLOCK), tl.float32)
        first = 0
        while first < tl.max(stop, 0):
            position = first + tl.arange(0, CHUNK)
            row, listed, mean_x, mean_y, a, b, c, opacity = load_splats(
                position, count, listed_rows, means2d, conics, opacities
            )
            alpha, _, _, _ = find_alphas(x, y, mean_x, mean_y, a, b, c, opacity)
            weight, light, stop = weigh(alpha, position, light, stop, count)
            shown = load_block(features, find_features(row, listed, index), listed, channel, channels)
            sums = tl.dot(tl.trans(weight), shown, sums, input_precision=PRECISION)
            first += CHUNK
        names = channel[None, :] + tl.zeros((PIXELS, 1), tl.int32)
        sums = tl.where(names < channels, sums, float("-inf"))
        taken = 0
        while taken < tl.minimum(top, channels - begin):
            value, name, sums = take_best(sums, names)
            best, named = keep_best(value, name, best, named)
            taken += 1
        begin += BLOCK
    best = tl.where(rank < top, best, float("-inf"))
    drawn = light < 1.0
    taken = 0
    while taken < top:
        value, name, best = take_best(best, named)
        tl.store(labels + pixel * top + taken, tl.where(drawn & (name < NONE), name, -1).to(tl.int64), mask=inside)
        tl.store(scores + pixel * top + taken, tl.where(drawn, value, 0.0), mask=inside)
        taken += 1
    tl.store(alphas + pixel, 1.0 - light, mask=inside)
