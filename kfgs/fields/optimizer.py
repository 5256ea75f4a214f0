"""Adam for the raw values of a cloud, and the density control of 3DGS, which changes the number of Gaussians in training."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from torch import Tensor

from ..gaussians import Gaussians
from .options import Densify, Training

Raw = dict[str, Tensor]
"""What is trained, by the names of `Rates`: "means", "quats", the logarithms of "scales", the logits of "opacities", and either
"features" or colours, "sh0" [N, 1, 3] and, above degree 0, "sh_rest" [N, K - 1, 3]: these two learn at different rates."""
ADAM_EPS = 1e-15  # of 3DGS: tiny, because gradients of a mean over all pixels are tiny
RESET_OPACITY = 0.01  # of 3DGS
_MOMENTS = ("exp_avg", "exp_avg_sq")
SPLIT_CHILDREN = 2
SPLIT_SHRINK = 1.6  # 0.8 times the number of children (3DGS)


def to_raw(gaussians: Gaussians) -> Raw:
    """The unbounded numbers of a cloud with features or colours; of both, features are taken.

    Scales of 0 become the smallest normal number, and opacities keep eps away from 0 and 1: their logarithms and logits are
    finite.
    """
    cloud, scales = gaussians.detach(), gaussians.scales.detach()
    logits = torch.logit(cloud.opacities.double(), eps=torch.finfo(scales.dtype).eps).to(scales.dtype)
    logs = scales.clamp_min(torch.finfo(scales.dtype).tiny).log()
    raw = {"means": cloud.means, "quats": cloud.quats, "scales": logs, "opacities": logits}
    if cloud.features is not None:
        return raw | {"features": cloud.features}
    assert cloud.sh is not None
    return raw | {"sh0": cloud.sh[:, :1]} | ({"sh_rest": cloud.sh[:, 1:]} if cloud.sh.shape[1] > 1 else {})


def to_gaussians(raw: Raw, like: Gaussians, sh_degree: int | None = None) -> Gaussians:
    """The cloud with these values, differentiable. Of colours, only harmonics up to `sh_degree` (None: all).

    Origin and antialiasing are those of `like`.
    """
    sh = raw.get("sh0")
    if "sh_rest" in raw and sh_degree != 0:
        sh = torch.cat(
            [raw["sh0"], raw["sh_rest"][:, : None if sh_degree is None else (sh_degree + 1) ** 2 - 1]], dim=1
        )
    shape = raw["means"], raw["quats"], raw["scales"].exp(), raw["opacities"].sigmoid()
    return Gaussians(*shape, raw.get("features"), sh, origin=like.origin, antialiased=like.antialiased)


class FieldOptimizer:
    """torch's fused Adam with one learning rate per kind of parameter, and moments that stay with their Gaussians.

    `raw` holds the leaf tensors that are being trained, `adam` their moments. Growing or pruning keeps the moments of
    every Gaussian that stays; new ones start at 0 (as in 3DGS).
    """

    def __init__(self, raw: Raw, training: Training) -> None:
        """Copy `raw` and prepare Adam; the extent of `training` is known."""
        self.raw, self._training = _leaves(raw), training
        groups = [{"params": [value], "name": name} for name, value in self.raw.items()]
        self.adam = torch.optim.Adam(groups, eps=ADAM_EPS, fused=True)

    def rate(self, name: str, step: int) -> float:
        """Learning rate of a parameter. That of the means falls from the first step on, and is in units of the extent."""
        rates, t = self._training.rates, step / self._training.steps
        if name == "means":
            assert self._training.extent is not None
            return rates.means ** (1 - t) * rates.means_final**t * self._training.extent
        return float(getattr(rates, name)) * rates.final ** max(0.0, 2 * t - 1)

    def step_(self, step: int) -> None:
        """Apply the gradients of step number `step`, then forget them."""
        for group in self.adam.param_groups:
            group["lr"] = self.rate(group["name"], step)
        self.adam.step()
        self.adam.zero_grad(set_to_none=True)

    def replace_(
        self,
        raw: Raw,  # of N' Gaussians
        parent: Tensor,  # [N'] int64
        fresh: Tensor,  # [N'] bool
    ) -> None:
        """Train `raw` from now on: row i takes the moments of old row `parent[i]`, or zeros where `fresh[i]`."""
        self.raw = _leaves(raw)
        for group, value in zip(self.adam.param_groups, self.raw.values(), strict=True):
            if state := self.adam.state.pop(group["params"][0], None):
                for moment in _MOMENTS:
                    state[moment] = state[moment][parent]
                    state[moment][fresh] = 0
                self.adam.state[value] = state
            group["params"] = [value]

    def lower_opacities_(self) -> None:
        """The opacity reset of 3DGS: to at most `RESET_OPACITY`. Their moments, which belong to the old values, are forgotten."""
        leaf = self.raw["opacities"]
        leaf.data.clamp_(max=math.log(RESET_OPACITY / (1 - RESET_OPACITY)))
        for moment in _MOMENTS:
            if moment in self.adam.state.get(leaf, {}):
                self.adam.state[leaf][moment].zero_()


def _leaves(raw: Raw) -> Raw:
    return {
        name: value.detach().clone(memory_format=torch.contiguous_format).requires_grad_()
        for name, value in raw.items()
    }


class GradientStatistics(NamedTuple):
    """Running sum of screen-space gradient norms per Gaussian, and its number of views."""

    total: Tensor  # [N]
    views: Tensor  # [N], number of views that saw it

    @staticmethod
    def zeros(means: Tensor) -> GradientStatistics:
        """Statistics of no view."""
        return GradientStatistics(*(means.new_zeros(len(means)) for _ in range(2)))

    def add_(
        self,
        index: Tensor,  # [M] int64, each Gaussian at most once
        gradient: Tensor,  # [M, 2] of the loss by means2d, in pixels
        size: tuple[int, int],  # (height, width)
    ) -> None:
        """Add one view. NDC spans 2 over the picture, so a gradient in NDC is half the size times one in pixels."""
        height, width = size
        norm = torch.hypot(gradient[:, 0] * (width / 2), gradient[:, 1] * (height / 2))
        self.total[index] += norm
        self.views[index] += 1

    def mean(self) -> Tensor:  # [N]
        """Mean norm over the views that saw the Gaussian; 0 if none did."""
        return self.total / self.views.clamp(min=1)


class Densified(NamedTuple):
    """The new cloud, and the Gaussian from which each of its rows comes."""

    raw: Raw
    parent: Tensor  # [N'] int64: row of the old cloud
    fresh: Tensor  # [N'] bool: a new Gaussian


def densify(
    raw: Raw,
    gradient: Tensor,  # [N] mean norm, NDC units
    options: Densify,
    *,
    extent: float,
    prune_large: bool,
    generator: torch.Generator,
) -> Densified:
    """One round of adaptive density control.

    A Gaussian with a gradient of at least `options.gradient` is cloned (an exact copy is added) if its largest scale
    is at most `percent_dense * extent`; otherwise two Gaussians of 1/1.6 its scales, drawn from its distribution, replace
    it. Then Gaussians below `prune_opacity`, and with `prune_large` those larger than `prune_extent * extent`, are dropped.
    Order of the result: old ones, clones, children. With a `maximum` the strongest gradients grow first (ties in order
    of index).

    Args:
        raw: the cloud; not changed.
        gradient: `GradientStatistics.mean()`.
        options: thresholds.
        extent: size of the scene, world units.
        prune_large: in 3DGS true only after the first reset of opacities.
        generator: draws the children's positions.

    Note:
        3DGS intends to prune Gaussians larger than 20 pixels on screen, but sets their radii to zero before the test, so
        it never does. Neither does this function.
    """
    values = {name: value.detach() for name, value in raw.items()}
    scales = values["scales"].exp().amax(dim=1)
    growing = gradient >= options.gradient
    if options.maximum is not None and len(scales) + int(growing.sum()) > options.maximum:  # each adds one Gaussian
        strongest = torch.where(growing, gradient, -torch.inf).argsort(descending=True, stable=True)
        growing[strongest[max(0, options.maximum - len(scales)) :]] = False
    large = scales > options.percent_dense * extent
    kept = (~(growing & large)).nonzero()[:, 0]
    cloned = (growing & ~large).nonzero()[:, 0]
    parents = (growing & large).nonzero()[:, 0].repeat_interleave(SPLIT_CHILDREN)

    parent = torch.cat([kept, cloned, parents])
    fresh = torch.arange(len(parent), device=parent.device) >= len(kept)
    grown = {name: value[parent] for name, value in values.items()}
    if len(parents):
        first = len(kept) + len(cloned)
        means = values["means"][parents]
        rotation = quaternion_to_rotation_matrix(values["quats"][parents])  # wxyz, normalises
        noise = torch.randn(means.shape, dtype=means.dtype, device=generator.device, generator=generator)
        away = noise.to(means.device) * values["scales"][parents].exp()
        grown["means"][first:] = means + (rotation @ away[:, :, None])[:, :, 0]
        grown["scales"][first:] -= math.log(SPLIT_SHRINK)

    stays = grown["opacities"].sigmoid() >= options.prune_opacity
    if prune_large:
        stays &= grown["scales"].exp().amax(dim=1) <= options.prune_extent * extent
    return Densified({name: value[stays] for name, value in grown.items()}, parent[stays], fresh[stays])
