"""What every compositing engine promises, and the three constants behind it.

An engine is one module on plain tensors that knows nothing of autograd, with

    DTYPES, devices() -> the floating-point types it computes in, and names of the device types it runs on
    forward(means2d [M, 2], conics [M, 3], opacities [M], features [N, D], background [D], index [M] | None,
            rows [P], offsets [T + 1], width, height, tile_size)
        -> maps [H, W, D], alphas [H, W], trace: one int32 tensor of the engine's own, for backward
    backward(grad_maps, grad_alphas, wanted: five bools, all arguments of forward, maps, alphas, trace)
        -> gradients of means2d, conics, opacities, features [N, D] and background; empty where not wanted
    accumulate(means2d, conics, opacities, pixels [H, W, D], rows, offsets, width, height, tile_size)
        -> sums [M, D], weights [M]

and, if it can do better than kornia and torch, `project`, `project_backward` and `bin`: the arguments and results are
those of `ops`, which turns these functions into operators. The reference engine is plain torch under autograd, and has
`composite` instead of forward and backward.

Gaussian m shows row index[m] of the features, or row m without an index.
Tile t owns `tiles.rows[tiles.offsets[t]:tiles.offsets[t + 1]]`, front to back; a row indexes the M projected Gaussians.
Tiles are numbered along image rows. The tensors an engine receives are contiguous, of one dtype and on one device.

1. Pixel (row i, column j) is sampled at (x, y) = (j + 0.5, i + 0.5). With d = (x, y) - mean and the conic (a, b, c), the
   density is exp(-0.5 (a dx^2 + 2 b dx dy + c dy^2)).
2. alpha = min(ALPHA_MAX, opacity * density). A Gaussian with alpha < ALPHA_MIN is skipped at that pixel. Before one is
   composited, T' = T * (1 - alpha) is computed; where T' < TRANSMITTANCE_MIN the pixel stops for good, *without* that
   Gaussian. Otherwise its features enter with weight alpha * T, and T becomes T'.
3. The order in a tile is depth, then Gaussian index (`bin_tiles` sees to it). On the CPU, equal input gives bit-equal
   output, forward and backward, on one machine.
4. maps = sum of weight * features + T * background, alphas = 1 - T, with T the transmittance the pixel ended with.
   Both are differentiable in means2d, conics, opacities, features and background; the gradient through a Gaussian is
   zero at pixels where its alpha is clamped or it is skipped. The decision where to stop has no gradient.
5. D is any size from 1, chosen at run time. M = 0 or an empty tile gives the background, alpha 0.
6. dtype in = dtype out. A conic that is not positive definite draws nothing on the compiled engines, whose rows and
   index must lie within what there is: this is checked on the CPU alone, for on a GPU the check would cost a wait.
   The CPU engines work in float64 too, so that `gradcheck` runs on them. No device moves, no
   printing, no edits to the caller's tensors.
7. Weights against a per-pixel signal (weights^T · pixels, for uplifting and pruning) and the sums of the weights come
   from one walk over the view: `accumulate`.

Two engines differ by rounding only. Thresholds make that visible at a few pixels where alpha lies on 1/255, or T' on
1e-4: two opaque hits give T' = (1 - 0.99)^2, which is just below 1e-4 in float32 and just above it in float64.

An engine may also have `similarity`: SSIM of two pictures and its gradient, with the arguments and results of the function
in `cpu/ssim.py`. The loss of colour fields uses it, and kornia's SSIM with the other engines.
"""

from __future__ import annotations

ALPHA_MAX = 0.99
"""Largest alpha: keeps 1 - alpha away from 0, by which the backward pass divides."""

ALPHA_MIN = 1 / 255
"""Smallest alpha composited: one step of an 8-bit image, and what makes a Gaussian's footprint finite."""

TRANSMITTANCE_MIN = 1e-4
"""A pixel stops before its transmittance falls below this: (1 - ALPHA_MAX)^2, two opaque hits."""
