"""What every compositing engine promises: its functions, the tuples they pass, and three constants.

An engine is one module on plain tensors that knows nothing of autograd, with

    DTYPES, devices() -> the floating-point types it computes in, and names of the device types it runs on
    forward(splats, tiles) -> Composited
    backward(grads, wanted, splats, tiles, result) -> gradients of the first five tensors of `splats`, empty where not wanted
        grads: of the loss in maps and alphas; wanted: five bools; result: what `forward` returned
    accumulate(means2d, conics, opacities, pixels [H, W, D], tiles) -> sums [M, D], weights [M]

and, if it can do better than kornia and torch,

    project(cloud, pinhole) -> the six tensors of `kfgs.splat.Projected`
    project_backward(grads, cloud, pinhole, index) -> gradients of the four tensors of `cloud`, zero for what was culled
        grads: of the loss in means2d, conics, depths and opacities; index: the last result of `project`
    shade(sh [N, K, 3], means, center [3], index) -> colours [M, 3], as `kfgs.splat.evaluate_sh` has them
    shade_backward(grad, sh, means, center, index) -> gradients of sh and means, zero for what was not seen
    bin(means2d, conics, depths, opacities, extents, width, height, tile_size) -> rows, offsets of `Tiles`
    rank(splats, tiles, top, early) -> Ranked: the channels with the largest sums, without writing the sums; no background

`ops` makes operators of these. The reference engine is plain torch under autograd: it has `composite(splats, tiles)`
instead of forward and backward. No function takes more than eight parameters, except compiled kernels: a launch of Triton
takes flat pointers, and numba's kernels take flat arrays. The schemas of operators are flat, too.

The tensors an engine receives are contiguous, of one dtype and on one device.

1. Pixel (row i, column j) is sampled at (x, y) = (j + 0.5, i + 0.5). With d = (x, y) - mean and the conic (a, b, c), the
   density is exp(-0.5 (a dx^2 + 2 b dx dy + c dy^2)).
2. alpha = min(ALPHA_MAX, opacity * density). A Gaussian with alpha < ALPHA_MIN is skipped at that pixel. Before one is
   composited, T' = T * (1 - alpha) is computed; where T' < TRANSMITTANCE_MIN the pixel stops for good, *without* that
   Gaussian. Otherwise its features enter with weight alpha * T, and T becomes T'.
3. The order in a tile is depth, then Gaussian index (`bin_tiles` sorts so). On the CPU, equal input gives bit-equal
   output, forward and backward, on one machine.
4. maps = sum of weight * features + T * background, alphas = 1 - T, with T the transmittance the pixel ended with.
   Both are differentiable in means2d, conics, opacities, features and background; the gradient through a Gaussian is
   zero at pixels where its alpha is clamped or it is skipped. The decision where to stop has no gradient.
5. D is any size from 1, chosen at run time. M = 0 or an empty tile gives the background, alpha 0.
6. dtype in = dtype out. A conic that is not positive definite draws nothing on the compiled engines. Their rows and
   index must lie within what there is. This is checked on the CPU only: on a GPU the check would cost a wait.
   The CPU engines work in float64 too, so that `gradcheck` runs on them. No device moves, no
   printing, no edits to the caller's tensors.
7. `accumulate` finds weights^T · pixels (for uplifting and pruning) and the sums of the weights in one walk over the view.
8. `rank` finds, at each pixel, the `top` channels with the largest sums of weight * features, the largest first, and of
   equal sums the lowest channel first. Where nothing is drawn, labels are -1 and scores 0. On the CPU the scores are the
   bits of `maps`. With `early` and one channel wanted, an engine may stop at a pixel where the sum of the best channel is
   positive and no other can overtake it: the label is the same, score and alpha are those reached there.

Two engines differ by rounding only. Thresholds make that visible at a few pixels where alpha lies on 1/255, or T' on
1e-4: two opaque hits give T' = (1 - 0.99)^2, which is just below 1e-4 in float32 and just above it in float64.

An engine may also have `absolute`, the mean absolute difference of two maps and its gradient, and `similarity`, SSIM and the
same difference of two pictures and a gradient, with the arguments and results of the functions in `cpu/absolute.py` and
`cpu/ssim.py`. The losses use them; with the other engines torch's operations and kornia's SSIM. It may
have `decide`, the largest output of a perceptron, as in `cpu/perceptron.py`: the exact decoding of a label map uses it, else
torch decodes.
"""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from ..._card import short_repr

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

    def __repr__(self) -> str:
        return short_repr(self)


class Pinhole(NamedTuple):
    """The camera and the options of `project`."""

    viewmat: Tensor  # [4, 4] world to camera
    K: Tensor  # [3, 3] without skew
    width: int  # pixels
    height: int  # pixels
    near: float  # smallest depth
    low_pass: float  # added variance, pixels^2

    def __repr__(self) -> str:
        return short_repr(self)


class Splats(NamedTuple):
    """The M projected Gaussians and what they show."""

    means2d: Tensor  # [M, 2] pixels (x, y)
    conics: Tensor  # [M, 3] (a, b, c)
    opacities: Tensor  # [M]
    features: Tensor  # [N, D]
    background: Tensor  # [D]
    index: Tensor | None  # type: ignore[assignment]  # [M] int64, the row of `features` of each; None: row m of Gaussian m

    def __repr__(self) -> str:
        return short_repr(self)


class Tiles(NamedTuple):
    """For every tile, the rows of `Projected` that touch it, in order of depth, then of Gaussian index.

    Tile t = row * columns + column owns `rows[offsets[t]:offsets[t + 1]]`. Tiles at the right and lower border reach
    beyond the image where its size is no multiple of the tile's.
    """

    rows: Tensor  # [P] int32
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


class Composited(NamedTuple):
    """The results of `forward`."""

    maps: Tensor  # [H, W, D]
    alphas: Tensor  # [H, W]
    trace: Tensor  # one int32 tensor of the engine's own, for its backward pass

    def __repr__(self) -> str:
        return short_repr(self)
