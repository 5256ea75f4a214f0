"""Losses that compare a rendered map with its target."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from .._check import check_range, check_shapes
from ..cameras import resize_map
from ..splat.engines.table import compiled_ssim
from ..splat.ssim import SSIM_CONSTANTS, SSIM_WINDOW, ssim_windows, window_weights

MOST = 2  # rendered pixels per pixel of the target, in a row: bilinear sampling reads all of them
Loss = Callable[[Tensor, Tensor, Tensor], Tensor]
"""(rendered map [H, W, D], its alpha [H, W], target [h, w, D]) -> a scalar."""


def l1_loss(
    rendered: Tensor,  # [H, W, D]
    alpha: Tensor,  # [H, W], not used
    target: Tensor,  # [h, w, D]
) -> Tensor:  # []
    """Eq. 4: the rendered map F_r, resized bilinearly to the size of the latent map F_l, against F_l (see `at_one_size`).

    The mean of the absolute differences over pixels and channels. The paper writes a norm, but its released script takes
    the mean, and learning rates and densification threshold of 3DGS are made for a mean. Pixels with NaN in any channel of
    the target are unknown and do not count.
    """
    return _Absolute.apply(*at_one_size(rendered, target))  # type: ignore[no-any-return]


@dataclass(frozen=True)
class ColorLoss:
    """The loss of 3DGS for colours: (1 - ssim_weight) L1 + ssim_weight (1 - SSIM).

    Pixels with NaN in any channel of the target are unknown: they and the SSIM windows that contain them do not count. A
    target with one channel more than the rendered map is a photograph with transparent pixels: its last channel is compared
    with the rendered opacity, so that the field becomes empty where the photograph is.

    Note:
        3DGS pads pictures with zeros for SSIM; here only windows inside the picture count, as in `kfgs.metrics.ssim`. A
        picture smaller than a window is compared by L1 only.
    """

    ssim_weight: float = 0.2
    """Lambda of 3DGS, in [0, 1]; 0 = L1 only."""

    def __post_init__(self) -> None:
        check_range("ssim_weight", self.ssim_weight, 0, 1)

    def __call__(self, rendered: Tensor, alpha: Tensor, target: Tensor) -> Tensor:
        """Compare a rendered picture [H, W, D] and its opacity [H, W] with the photograph [h, w, D] or [h, w, D + 1]."""
        if target.shape[2] == rendered.shape[2] + 1:
            rendered = torch.cat([rendered, alpha[..., None]], dim=2)
        if self.ssim_weight == 0 or min(target.shape[:2]) < SSIM_WINDOW:
            return l1_loss(rendered, alpha, target)
        picture, target = at_one_size(rendered, target)
        compiled = _compiled(picture, target)
        if compiled is not None and not bool(target.sum().isnan()):  # no unknown pixel: one walk for both slopes
            mix = -self.ssim_weight, 1 - self.ssim_weight
            return self.ssim_weight + _Similarity.apply(picture, target, None, mix, compiled)
        absolute, dissimilar = l1_loss(picture, alpha, target), 1 - mean_similarity(picture, target)
        return (1 - self.ssim_weight) * absolute + self.ssim_weight * dissimilar


def mean_similarity(picture: Tensor, target: Tensor) -> Tensor:  # [H, W, D] x 2 -> []
    """Mean SSIM over the windows without a NaN (Gaussian, 11x11, sigma 1.5); 1 if there is none. Differentiable in `picture`.

    The engine's if it has one (1.2 ms instead of kornia's 37 at 240x320, two threads), else by kornia's filters.
    """
    known, counted = _known(target), None
    if not bool(known.all()):
        picture, target = (torch.where(known[..., None], value, 0) for value in (picture, target))
        counted = torch.nn.functional.max_pool2d((~known).to(picture)[None], SSIM_WINDOW, stride=1)[0] == 0
        if not bool(counted.any()):
            return picture.new_ones(())
    if (compiled := _compiled(picture, target)) is not None:
        return _Similarity.apply(picture, target, counted, (1.0, 0.0), compiled)  # type: ignore[no-any-return]
    similarity = ssim_windows(picture, target)
    return similarity.mean() if counted is None else similarity[counted].mean()


def at_one_size(rendered: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:  # [H, W, D], [h, w, D] -> [h', w', D] x 2
    """The rendering resized bilinearly to the target, of which a coarse one is enlarged first: its pixels are repeated.

    Beyond a factor of 2 bilinear sampling skips pixels: of 640x480 to 46x34 it reads 4 of 196, and only these would learn.
    Block means reach all, but L1 gives a block one sign, which makes Gaussians many: in room_0 87,000 at step 1,500, not 55,000.
    """
    check_shapes(("rendered", rendered, ("H", "W", target.shape[2])))  # compiled code would read beyond the smaller one
    for axis in (0, 1):
        if (times := -(-rendered.shape[axis] // max(1, MOST * target.shape[axis]))) > 1:
            target = target.repeat_interleave(times, dim=axis)
    return resize_map(rendered, (target.shape[0], target.shape[1])), target


def _compiled(picture: Tensor, target: Tensor) -> Callable[..., Any] | None:
    """The engine's SSIM; None if kornia's filters must do, as for a gradient in the target."""
    return None if target.requires_grad else compiled_ssim(picture, target)


def _known(target: Tensor) -> Tensor:  # [H, W, D] -> [H, W] bool
    return ~target.amax(dim=2).isnan()  # amax returns NaN; 9 times faster than isnan().any(dim=2) of 64 channels


class _Absolute(torch.autograd.Function):
    """The mean absolute difference. Its slope takes the memory of the difference; autograd would take three times as much."""

    @staticmethod
    def forward(ctx: Any, picture: Tensor, target: Tensor) -> Tensor:
        difference, share, more = picture - target, 1 / max(1, target.numel()), 1.0
        if bool((total := difference.abs().sum()).isnan()):
            difference[~(known := _known(target))] = 0
            total, more = difference.abs().sum(), known.numel() / max(1, int(known.sum()))
        slope = difference.sign_().mul_(share)
        ctx.save_for_backward(slope if more == 1 else slope.mul_(more))
        return total * (share * more)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor | None]:
        slope = grad * ctx.saved_tensors[0]
        return slope, -slope if ctx.needs_input_grad[1] else None


class _Similarity(torch.autograd.Function):
    """mix[0] times the engine's SSIM plus mix[1] times the mean absolute difference, and their slope in one walk."""

    @staticmethod
    def forward(ctx: Any, picture: Tensor, target: Tensor, counted: Any, mix: Any, compiled: Any) -> Tensor:
        pictures, window = (picture.contiguous(), target.contiguous()), window_weights(picture.dtype)
        similar, slope = compiled(*pictures, counted, window, SSIM_CONSTANTS, mix)
        ctx.save_for_backward(slope)
        return mix[0] * similar + mix[1] * (picture - target).abs().mean() if mix[1] else mix[0] * similar

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        return grad * ctx.saved_tensors[0], None, None, None, None
