"""The Triton kernels that walk front to back: compositing, and accumulating pixels into Gaussians.

A program works on PIXELS pixels of one tile (PARTS programs share a tile), and on CHUNK Gaussians of the tile's list at
a time. Everything that depends on both lies in [CHUNK, PIXELS]: Triton spreads the last axis over the threads, so each
thread holds its pixel's whole chunk, and the product of transmittances runs in registers. What goes over the channels
is a matrix product of such a block with BLOCK channels, on the tensor cores if there are many channels.

Positions in a tile's list count from its start, in int32; memory offsets that channels multiply are int64.
"""

# mypy: disable-error-code="no-untyped-def"
# Triton gives the arguments their types when it compiles; only constants are annotated.

import triton
import triton.language as tl

from ..contract import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

MOST = tl.constexpr(ALPHA_MAX)
LEAST = tl.constexpr(ALPHA_MIN)
END = tl.constexpr(TRANSMITTANCE_MIN)

SIZES = ["width", "height", "columns"]
"""Arguments of every kernel whose change needs no new compilation: for example the size of the image."""


@triton.jit
def place_pixels(columns, width, height, SIDE: tl.constexpr, PARTS: tl.constexpr, PIXELS: tl.constexpr):
    """This program's tile, and its pixels: which they are in the image, their centres, and whether the image has them.

    The pixels of a tile are numbered along its rows; a number beyond SIDE * SIDE is no pixel.
    """
    tile = tl.program_id(0) // PARTS
    within = (tl.program_id(0) % PARTS) * PIXELS + tl.arange(0, PIXELS)
    column = (tile % columns) * SIDE + within % SIDE
    row = (tile // columns) * SIDE + within // SIDE
    inside = (within < SIDE * SIDE) & (column < width) & (row < height)
    pixel = row.to(tl.int64) * width + column
    return tile, pixel, column.to(tl.float32) + 0.5, row.to(tl.float32) + 0.5, inside


@triton.jit
def find_list(tile, rows, offsets):
    """Where the tile's list starts, and how many Gaussians it has."""
    start = tl.load(offsets + tile)
    return rows + start, (tl.load(offsets + tile + 1) - start).to(tl.int32)


@triton.jit
def load_splats(position, count, listed_rows, means2d, conics, opacities):
    """The Gaussians [CHUNK] at `position` of a list; beyond its end the opacity is 0."""
    listed = position < count
    row = tl.load(listed_rows + position, mask=listed, other=0).to(tl.int64)
    mean_x = tl.load(means2d + 2 * row, mask=listed, other=0.0)
    mean_y = tl.load(means2d + 2 * row + 1, mask=listed, other=0.0)
    a = tl.load(conics + 3 * row, mask=listed, other=0.0)
    b = tl.load(conics + 3 * row + 1, mask=listed, other=0.0)
    c = tl.load(conics + 3 * row + 2, mask=listed, other=0.0)
    opacity = tl.load(opacities + row, mask=listed, other=0.0)
    return row, listed, mean_x, mean_y, a, b, c, opacity


@triton.jit
def find_alphas(x, y, mean_x, mean_y, a, b, c, opacity):
    """alpha, 0 where skipped, and before it was clamped; and the way from the mean to the pixel: [CHUNK, PIXELS]."""
    dx = x[None, :] - mean_x[:, None]
    dy = y[None, :] - mean_y[:, None]
    power = -0.5 * (a[:, None] * dx * dx + c[:, None] * dy * dy) - b[:, None] * dx * dy
    full = opacity[:, None] * tl.exp(power)
    return tl.where(full >= LEAST, tl.minimum(full, MOST), 0.0), full, dx, dy


@triton.jit
def weigh(alpha, position, light, stop, count):
    """Weights [CHUNK, PIXELS] of a chunk, and the pixels' transmittance and stop [PIXELS] after it.

    A pixel stops at the first position whose Gaussian would leave less than END; what is drawn lies before it. A tree
    of products may round a later one up, so the position is kept and not a comparison.
    """
    passed = 1.0 - alpha
    left = light[None, :] * tl.cumprod(passed, 0)
    stop = tl.minimum(stop, tl.min(tl.where(left < END, position[:, None], count), 0))
    drawn = position[:, None] < stop[None, :]
    weight = tl.where(drawn, alpha * (left / passed), 0.0)
    light = tl.minimum(light, tl.min(tl.where(drawn, left, 1.0), 0))
    return weight, light, stop


@triton.jit
def load_block(base, line, lines, channel, channels):
    """Rows `line` of an array with `channels` columns, at the columns `channel`: [lines, BLOCK], 0 where there is none."""
    there = lines[:, None] & (channel < channels)[None, :]
    return tl.load(base + line[:, None] * channels + channel[None, :], mask=there, other=0.0)


@triton.jit
def add_block(base, line, lines, channel, channels, part):
    """Add a part [lines, BLOCK] to what `load_block` reads."""
    there = lines[:, None] & (channel < channels)[None, :]
    tl.atomic_add(base + line[:, None] * channels + channel[None, :], part, mask=there, sem="relaxed")


@triton.jit
def sum_pixels(weight, values, CHUNK: tl.constexpr, PIXELS: tl.constexpr, BLOCK: tl.constexpr, PRECISION: tl.constexpr):
    """The product weight [CHUNK, PIXELS] · values [PIXELS, BLOCK], in slices of a warp's pixels that are added up.

    As one product, every warp would hold all the weights in registers, and spill them.
    """
    SLICES: tl.constexpr = (PIXELS + 31) // 32
    EACH: tl.constexpr = PIXELS // SLICES
    left = tl.permute(tl.reshape(weight, (CHUNK, SLICES, EACH)), (1, 0, 2))
    parts = tl.dot(left, tl.reshape(values, (SLICES, EACH, BLOCK)), input_precision=PRECISION)
    return tl.sum(parts, 0)


@triton.jit
def find_features(row, listed, index):
    """Which row of the features each Gaussian shows."""
    if index is None:
        return row
    else:  # Triton takes one of the branches while it compiles
        return tl.load(index + row, mask=listed, other=0).to(tl.int64)


@triton.jit(do_not_specialize=SIZES)
def composite_kernel(
    means2d, conics, opacities, features, background, index, rows, offsets,
    maps, alphas, stops, lights,
    width, height, columns, channels,
    SIDE: tl.constexpr, PARTS: tl.constexpr, PIXELS: tl.constexpr,
    CHUNK: tl.constexpr, BLOCK: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Composite BLOCK channels at PIXELS pixels; the first block also writes alphas, stops and transmittances."""
    tile, pixel, x, y, inside = place_pixels(columns, width, height, SIDE, PARTS, PIXELS)
    listed_rows, count = find_list(tile, rows, offsets)
    channel = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
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
    behind = tl.load(background + channel, mask=channel < channels, other=0.0)
    there = inside[:, None] & (channel < channels)[None, :]
    tl.store(maps + pixel[:, None] * channels + channel[None, :], sums + light[:, None] * behind[None, :], mask=there)
    if tl.program_id(1) == 0:
        tl.store(alphas + pixel, 1.0 - light, mask=inside)
        tl.store(stops + pixel, stop, mask=inside)
        tl.store(lights + pixel, light, mask=inside)


@triton.jit(do_not_specialize=SIZES)
def accumulate_kernel(
    means2d, conics, opacities, pixels, rows, offsets,
    sums, weights,
    width, height, columns, channels,
    SIDE: tl.constexpr, PARTS: tl.constexpr, PIXELS: tl.constexpr,
    CHUNK: tl.constexpr, BLOCK: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Add weight * pixels, BLOCK channels of it, to the Gaussians; the first block also adds the weights."""
    tile, pixel, x, y, inside = place_pixels(columns, width, height, SIDE, PARTS, PIXELS)
    listed_rows, count = find_list(tile, rows, offsets)
    channel = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    values = load_block(pixels, pixel, inside, channel, channels)
    light = tl.full((PIXELS,), 1.0, tl.float32)
    stop = tl.where(inside, count, 0)
    first = 0
    while first < tl.max(stop, 0):
        position = first + tl.arange(0, CHUNK)
        row, listed, mean_x, mean_y, a, b, c, opacity = load_splats(
            position, count, listed_rows, means2d, conics, opacities
        )
        alpha, _, _, _ = find_alphas(x, y, mean_x, mean_y, a, b, c, opacity)
        weight, light, stop = weigh(alpha, position, light, stop, count)
        part = sum_pixels(weight, values, CHUNK, PIXELS, BLOCK, PRECISION)
        add_block(sums, row, listed, channel, channels, part)
        if tl.program_id(1) == 0:
            tl.atomic_add(weights + row, tl.sum(weight, 1), mask=listed, sem="relaxed")
        first += CHUNK
