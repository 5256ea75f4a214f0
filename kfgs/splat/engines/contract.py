"""What every engine promises: the class `Engine`, the tuples it takes and gives, and three constants.

1. Pixel (row i, column j) is sampled at (x, y) = (j + 0.5, i + 0.5). With d = (x, y) - mean and the conic (a, b, c), the
   density is exp(-0.5 (a dx^2 + 2 b dx dy + c dy^2)).
2. alpha = min(ALPHA_MAX, opacity * density). A Gaussian with alpha < ALPHA_MIN is skipped at that pixel. Before one is
   composited, T' = T * (1 - alpha) is computed; where T' < TRANSMITTANCE_MIN the pixel stops for good, *without* that
   Gaussian. Otherwise its features enter with weight alpha * T, and T becomes T'.
3. The order in a tile is depth, then Gaussian index (`bin_tiles` sorts so). On the CPU, equal input gives bit-equal
   output, forward and backward, on one machine.
4. maps = sum of weight * features + T * background, alphas = 1 - T, with T the transmittance the pixel ended with.
   Both are differentiable in means2d, conics, opacities, features and background; the gradient through a Gaussian is
   zero at pixels where its alpha is clamped or it is skipped. The decision where to stop has no gradient. Compiled engines
   have no gradient of the gradient.
5. D is any size from 1, chosen at run time. M = 0 or an empty tile gives the background, alpha 0.
6. dtype in = dtype out. A conic that is not positive definite draws nothing on the numba engine. The CPU engines work in
   float64 too, so that `gradcheck` runs on them. No device moves, no printing, no edits to the caller's tensors.

Two engines differ by rounding only. Thresholds make that visible at a few pixels where alpha lies on 1/255, or T' on
1e-4: two opaque hits give T' = (1 - 0.99)^2, which is just below 1e-4 in float32 and just above it in float64.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..._card import short_repr
from ..sh import evaluate_sh

ALPHA_MAX = 0.99
"""Largest alpha: keeps 1 - alpha away from 0, by which the backward pass divides."""

ALPHA_MIN = 1 / 255
"""Smallest alpha composited: one step of an 8-bit image, and what makes a Gaussian's footprint finite."""

TRANSMITTANCE_MIN = 1e-4
"""A pixel stops before its transmittance falls below this: (1 - ALPHA_MAX)^2, two opaque hits."""


class Cloud(NamedTuple):
    """The N Gaussians that `project` takes."""

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4] (w, x, y, z) of any length
    scales: Tensor  # [N, 3] standard deviations
    opacities: Tensor  # [N]


class Pinhole(NamedTuple):
    """What `project` takes of the camera, and its options."""

    viewmat: Tensor  # [4, 4] world to camera
    K: Tensor  # [3, 3] without skew
    width: int  # pixels
    height: int  # pixels
    near: float  # smallest depth
    low_pass: float  # added variance, pixels^2


class Splats(NamedTuple):
    """The M projected Gaussians and what they show."""

    means2d: Tensor  # [M, 2] pixels (x, y)
    conics: Tensor  # [M, 3] (a, b, c)
    opacities: Tensor  # [M]
    features: Tensor  # [N, D]
    background: Tensor  # [D]
    index: Tensor | None  # type: ignore[assignment]  # [M] int64, the row of `features` of each; None: row m of Gaussian m


class Tiles(NamedTuple):
    """For every tile, the rows of `Projected` that touch it, in order of depth, then of Gaussian index.

    Tile t = row * columns + column owns `rows[offsets[t]:offsets[t + 1]]`. Tiles at the right and lower border reach
    beyond the image where its size is no multiple of the tile's.
    """

    rows: Tensor  # [P] int32; some that no tile owns may follow the last tile's
    offsets: Tensor  # [T + 1] int64
    width: int  # pixels
    height: int  # pixels
    tile_size: int  # pixels

    def __repr__(self) -> str:
        return short_repr(self)

    @property
    def grid(self) -> tuple[int, int]:
        """Number of tiles as (rows, columns)."""
        return -(-self.height // self.tile_size), -(-self.width // self.tile_size)


class Composited(NamedTuple):
    """The results of `CompiledEngine.forward`."""

    maps: Tensor  # [H, W, D]
    alphas: Tensor  # [H, W]
    trace: Tensor  # one int32 tensor of the engine's own, for its backward pass


class Ranked(NamedTuple):
    """The best channels of each pixel: classes, if the features are scores of classes."""

    labels: Tensor  # [H, W, top] int64, the best first; -1 where nothing was drawn
    scores: Tensor  # [H, W, top] their sums of weight * features; 0 where nothing was drawn
    alphas: Tensor  # [H, W]

    def __repr__(self) -> str:
        return short_repr(self)

    @staticmethod
    def of_map(maps: Tensor, alphas: Tensor, top: int) -> Ranked:  # [H, W, D], [H, W]
        """The best channels of a finished map."""
        scores, labels = (value[..., :top] for value in maps.sort(dim=-1, descending=True, stable=True))
        empty = (alphas <= 0)[..., None]
        return Ranked(labels.masked_fill(empty, -1), scores.masked_fill(empty, 0), alphas)


class Engine:
    """Compositing on one kind of device. Tensors come contiguous, of one dtype and on one device."""

    devices: tuple[str, ...]
    """Types of the devices that it runs on."""
    dtypes: tuple[torch.dtype, ...] = (torch.float32, torch.float64)
    """The types that it computes in."""
    tile_size = 16
    """Side of the tiles that it composites fastest, pixels."""
    projects = False
    """Whether it also has `project`, `shade` and `bin`. If not, `kfgs.splat` does these by kornia and torch."""

    def composite(self, splats: Splats, tiles: Tiles) -> tuple[Tensor, Tensor]:  # maps [H, W, D], alphas [H, W]
        """Composite as this file says, differentiable."""
        raise NotImplementedError

    def accumulate(
        self, means2d: Tensor, conics: Tensor, opacities: Tensor, pixels: Tensor, tiles: Tiles
    ) -> tuple[Tensor, Tensor]:  # sums [M, D], weights [M]
        """weights^T · pixels [H, W, D] and the sums of the weights, in one walk over the view; without gradient."""
        raise NotImplementedError

    def rank(self, splats: Splats, tiles: Tiles, top: int, early: bool) -> Ranked:
        """The `top` channels with the largest sums of weight * features at each pixel; without gradient or background.

        The largest comes first, of equal sums the lowest channel. Where nothing is drawn, labels are -1 and scores 0. On the
        CPU the scores are the bits of `maps`. With `early` and one channel wanted, an engine may stop at a pixel where the
        best sum is positive and no other can overtake it: the label is the same, score and alpha are those reached there.
        """
        return Ranked.of_map(*self.composite(splats, tiles), top)

    def project(self, cloud: Cloud, pinhole: Pinhole) -> tuple[Tensor, ...]:
        """The six tensors of `kfgs.splat.Projected`, differentiable in the cloud."""
        raise NotImplementedError

    def shade(self, sh: Tensor, means: Tensor, center: Tensor, index: Tensor) -> Tensor:  # [M, 3]
        """Colours of the rows `index` [M] of `sh` [N, K, 3] and `means` [N, 3] from `center` [3], as `evaluate_sh` has them."""
        # index_select: its gradient takes half the time of that of an index in brackets
        return evaluate_sh(sh.index_select(0, index), means.index_select(0, index) - center)

    def bin(self, *projected: Tensor, size: tuple[int, int, int]) -> tuple[Tensor, Tensor]:
        """`rows` and `offsets` of `Tiles`, of the first five tensors of `Projected`; `size` is width, height and tile size."""
        raise NotImplementedError


class CompiledEngine(Engine):
    """An engine whose kernels compute their own gradients."""

    def forward(self, splats: Splats, tiles: Tiles) -> Any:
        """A named tuple of tensors: `maps`, `alphas`, and what `backward` needs."""
        raise NotImplementedError

    def backward(
        self, grads: tuple[Tensor, Tensor], wanted: list[bool], splats: Splats, tiles: Tiles, result: Any
    ) -> list[Tensor | None]:
        """Gradients of the first five tensors of `splats` (None where not wanted), given those in maps and alphas."""
        raise NotImplementedError

    def composite(self, splats: Splats, tiles: Tiles) -> tuple[Tensor, Tensor]:
        """Composite as this file says, differentiable once."""
        return _Composite.apply(self, tiles, *splats)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, engine: CompiledEngine, tiles: Tiles, *splats: Tensor) -> tuple[Tensor, Tensor]:
        result = engine.forward(Splats(*splats), tiles)
        ctx.engine, ctx.size, ctx.kind = engine, tiles[2:], type(result)
        ctx.save_for_backward(*splats, *tiles[:2], *result)
        return result.maps, result.alphas

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_maps: Tensor, grad_alphas: Tensor) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        splats, tiles, result = Splats(*saved[:6]), Tiles(*saved[6:8], *ctx.size), ctx.kind(*saved[8:])
        grads = grad_maps.contiguous(), grad_alphas.contiguous()
        return None, None, *ctx.engine.backward(grads, ctx.needs_input_grad[2:7], splats, tiles, result), None
