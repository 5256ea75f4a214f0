"""The reference engine: compositing in plain torch, many tiles at a time, with gradients by autograd.

It states the contract as directly as tensors allow, and faster engines are compared with it. B tiles with similarly many
Gaussians are stacked, and walked front to back in chunks of C Gaussians at P pixels. Autograd over a whole picture would
keep every alpha. So the backward pass replays the chunks, last to first, from the transmittance that each started with.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from .contract import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN, Engine, Splats, Tiles

CHUNK = 64
"""Gaussians of a tile composited at once; pixels that stop are noticed between chunks."""

BATCH = 1 << 20
"""Largest B * P * C: elements of one intermediate tensor, a few megabytes."""


class _Chunk(NamedTuple):
    """What the backward pass needs to replay a chunk."""

    tiles: Tensor  # [B] which tiles
    rows: Tensor  # [B, C] which Gaussians, padded with any
    present: Tensor  # [B, C] False at padding
    transmittance: Tensor  # [B, P] at the start
    stopped: Tensor  # [B, P] pixels that had stopped before


class ReferenceEngine(Engine):
    """Compositing as the contract states it."""

    devices = "cpu", "cuda"

    def composite(self, splats: Splats, tiles: Tiles) -> tuple[Tensor, Tensor]:
        *footprints, features, background, index = splats
        features = features if index is None else features[index]
        sums, transmittance = _Composite.apply(*footprints, features, tiles)
        sums = sums + transmittance[..., None] * background
        return _to_image(sums, tiles), 1 - _to_image(transmittance[..., None], tiles)[..., 0]

    def accumulate(
        self, means2d: Tensor, conics: Tensor, opacities: Tensor, pixels: Tensor, tiles: Tiles
    ) -> tuple[Tensor, Tensor]:
        signal = _to_tiles(torch.cat([pixels, torch.ones_like(pixels[..., :1])], dim=2), tiles)  # [T, P, D + 1]
        T, P = signal.shape[:2]
        transmittance, stopped = pixels.new_ones(T, P), torch.zeros(T, P, dtype=torch.bool, device=pixels.device)
        sums = pixels.new_zeros(len(means2d), signal.shape[2])
        for batch in _batches(tiles):
            for tile, which, present in _front_to_back(tiles, batch, stopped):
                chunk = _Chunk(tile, which, present, transmittance[tile], stopped[tile])
                splats = (value[which] for value in (means2d, conics, opacities))
                weights, transmittance[tile], stopped[tile] = _weigh_chunk(chunk, tiles, chunk.transmittance, *splats)
                sums.index_add_(0, which.flatten(), (weights.mT @ signal[tile]).flatten(0, 1))
        return sums[:, :-1], sums[:, -1]


class _Composite(torch.autograd.Function):
    """Sum of weight * features, [T, P, D], and final transmittance, [T, P], per tile and pixel of a tile."""

    @staticmethod
    def forward(
        ctx: Any, means2d: Tensor, conics: Tensor, opacities: Tensor, features: Tensor, tiles: Tiles
    ) -> tuple[Tensor, Tensor]:
        T, P = len(tiles.offsets) - 1, tiles.tile_size**2
        sums = features.new_zeros(T, P, features.shape[1])
        transmittance = features.new_ones(T, P)
        stopped = torch.zeros(T, P, dtype=torch.bool, device=features.device)
        splats = (means2d, conics, opacities, features)
        ctx.save_for_backward(*splats)
        ctx.tiles, ctx.chunks = tiles, []
        for batch in _batches(tiles):
            for tile, rows, present in _front_to_back(tiles, batch, stopped):
                chunk = _Chunk(tile, rows, present, transmittance[tile], stopped[tile])
                weights, transmittance[tile], stopped[tile] = _weigh_chunk(
                    chunk, tiles, chunk.transmittance, *(value[rows] for value in splats[:3])
                )
                sums[tile] += weights @ features[rows]
                if any(ctx.needs_input_grad):
                    ctx.chunks.append(chunk)
        return sums, transmittance

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_sums: Tensor, grad_transmittance: Tensor) -> tuple[Tensor | None, ...]:
        splats = ctx.saved_tensors
        grads = [torch.zeros_like(value) for value in splats]
        grad_transmittance = grad_transmittance.clone()  # of what a chunk hands on; becomes that of what it was given
        for chunk in reversed(ctx.chunks):
            inputs = [chunk.transmittance, *(value[chunk.rows] for value in splats)]
            with torch.enable_grad():
                inputs = [value.detach().requires_grad_() for value in inputs]
                weights, transmittance, _ = _weigh_chunk(chunk, ctx.tiles, *inputs[:4])
                outputs = weights @ inputs[4], transmittance
            upstream = grad_sums[chunk.tiles], grad_transmittance[chunk.tiles]
            given, *local = torch.autograd.grad(outputs, inputs, upstream)
            grad_transmittance[chunk.tiles] = given
            for total, part in zip(grads, local, strict=True):
                total.index_add_(0, chunk.rows.flatten(), part.flatten(0, 1))
        return (*grads, None)


def _weigh_chunk(
    chunk: _Chunk,
    tiles: Tiles,
    transmittance: Tensor,  # [B, P] at the start
    means2d: Tensor,  # [B, C, 2]
    conics: Tensor,  # [B, C, 3]
    opacities: Tensor,  # [B, C]
) -> tuple[Tensor, Tensor, Tensor]:
    """Weights [B, P, C] of C Gaussians at every pixel of B tiles; transmittance [B, P], stopped [B, P] after them."""
    alphas = _alphas(_pixel_centers(chunk.tiles, tiles, means2d.dtype), means2d, conics, opacities)  # [B, P, C]
    alphas = torch.where((alphas >= ALPHA_MIN) & chunk.present[:, None], alphas, 0)
    start = transmittance[..., None]
    with torch.no_grad():  # T * (1 - alpha) only falls, so a pixel that stops is below the limit ever after
        left = torch.cumprod(torch.cat([start, 1 - alphas], dim=2), dim=2)[..., 1:]
        live = (left >= TRANSMITTANCE_MIN) & ~chunk.stopped[..., None]
    alphas = torch.where(live, alphas, 0)
    left = torch.cumprod(torch.cat([start, 1 - alphas], dim=2), dim=2)  # before each Gaussian, and after the last
    return alphas * left[..., :-1], left[..., -1], ~live[..., -1]


def _alphas(
    centers: Tensor,  # [B, P, 2]
    means2d: Tensor,  # [B, C, 2]
    conics: Tensor,  # [B, C, 3]
    opacities: Tensor,  # [B, C]
) -> Tensor:  # [B, P, C]
    """min(ALPHA_MAX, opacity * exp(-0.5 d^T C d)) at every pixel."""
    dx = centers[:, :, None, 0] - means2d[:, None, :, 0]
    dy = centers[:, :, None, 1] - means2d[:, None, :, 1]
    a, b, c = conics[:, None].unbind(3)  # [B, 1, C] each
    density = torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    return (opacities[:, None] * density).clamp(max=ALPHA_MAX)


def _pixel_centers(tile: Tensor, tiles: Tiles, dtype: torch.dtype) -> Tensor:  # [B] -> [B, P, 2] (x, y)
    columns = tiles.grid[1]
    corner = torch.stack([tile % columns, tile // columns], dim=1) * tiles.tile_size
    pixel = torch.arange(tiles.tile_size**2, device=tile.device)
    within = torch.stack([pixel % tiles.tile_size, pixel // tiles.tile_size], dim=1)
    return (corner[:, None] + within).to(dtype) + 0.5


def _batches(tiles: Tiles) -> Iterator[Tensor]:
    """Tiles that have Gaussians, stacked with those that have about as many: [B] int64 each."""
    counts = tiles.offsets.diff()
    order = torch.argsort(counts, descending=True, stable=True)[: int((counts > 0).sum())]
    if len(order):
        yield from order.split(max(1, BATCH // (CHUNK * tiles.tile_size**2)))


def _front_to_back(tiles: Tiles, batch: Tensor, stopped: Tensor) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Chunks (tile [B], rows [B, C], present [B, C]) of a batch, without the tiles that are done."""
    counts = tiles.offsets.diff()[batch]
    for start in range(0, int(counts.max()), CHUNK):
        going = (counts > start) & ~stopped[batch].all(dim=1)
        batch, counts = batch[going], counts[going]
        if len(batch) == 0:
            return
        place = torch.arange(start, min(start + CHUNK, int(counts.max())), device=batch.device)
        present = place < counts[:, None]
        places = tiles.offsets[batch][:, None] + torch.where(present, place, 0)
        yield batch, tiles.rows[places].long(), present


def _to_image(values: Tensor, tiles: Tiles) -> Tensor:  # [T, P, D] -> [H, W, D]
    """Lay the tiles side by side and cut what reaches beyond the image."""
    (rows, columns), side = tiles.grid, tiles.tile_size
    image = values.view(rows, columns, side, side, -1).transpose(1, 2).reshape(rows * side, columns * side, -1)
    return image[: tiles.height, : tiles.width]


def _to_tiles(image: Tensor, tiles: Tiles) -> Tensor:  # [H, W, D] -> [T, P, D]
    """The inverse of `_to_image`: what reaches beyond the image is 0."""
    (rows, columns), side = tiles.grid, tiles.tile_size
    padded = image.new_zeros(rows * side, columns * side, image.shape[2])
    padded[: tiles.height, : tiles.width] = image
    return padded.view(rows, side, columns, side, -1).transpose(1, 2).reshape(rows * columns, side * side, -1)


ENGINE = ReferenceEngine()
