"""Adam for the raw values of a cloud; the number of Gaussians may change during training."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from .params import GaussianParams
from .training import Training

_MOMENTS = ("exp_avg", "exp_avg_sq")


class FieldOptimizer:
    """torch's fused Adam with one learning rate per kind of parameter, and moments that stay with their Gaussians.

    `params` holds the leaf tensors that are being trained, `adam` their moments. Growing or pruning keeps the moments of
    every Gaussian that stays; new ones start at 0 (as in 3DGS).
    """

    def __init__(self, params: GaussianParams, training: Training) -> None:
        """Copy `params` and prepare Adam; the extent of `training` is known."""
        self.params, self._training = params.map(_leaf), training
        groups = [{"params": [value], "name": name} for name, value in self.params.to_tensors().items()]
        self.adam = torch.optim.Adam(groups, eps=training.rates.adam_eps, fused=True)

    def rate(self, name: str, step: int) -> float:
        """Learning rate of a parameter. That of the means falls from the first step on, and is in units of the extent."""
        rates, t = self._training.rates, step / self._training.steps
        if name == "means":
            assert self._training.extent is not None
            return rates.means ** (1 - t) * rates.means_final**t * self._training.extent
        own: float = getattr(rates, name.removeprefix("log_").removeprefix("logit_"))
        return own * rates.final ** max(0.0, 2 * t - 1)

    def step_(self, step: int) -> None:
        """Apply the gradients of step number `step`, then forget them."""
        for group in self.adam.param_groups:
            group["lr"] = self.rate(group["name"], step)
        self.adam.step()
        self.adam.zero_grad(set_to_none=True)

    def replace_(
        self,
        params: GaussianParams,  # N' Gaussians
        source: Tensor,  # [N'] int64
        fresh: Tensor,  # [N'] bool
    ) -> None:
        """Train `params` from now on: row i takes the moments of old row `source[i]`, or zeros where `fresh[i]`."""
        self.params = params.map(_leaf)
        for group, value in zip(self.adam.param_groups, self.params.to_tensors().values(), strict=True):
            if state := self.adam.state.pop(group["params"][0], None):
                for moment in _MOMENTS:
                    state[moment] = state[moment][source]
                    state[moment][fresh] = 0
                self.adam.state[value] = state
            group["params"] = [value]

    def lower_opacities_(self, opacity: float) -> None:
        """The opacity reset of 3DGS: to at most `opacity`. Their moments, which belong to the old values, are forgotten."""
        leaf = self.params.logit_opacities
        leaf.data.clamp_(max=math.log(opacity / (1 - opacity)))
        for moment in _MOMENTS:
            if moment in self.adam.state.get(leaf, {}):
                self.adam.state[leaf][moment].zero_()


def _leaf(value: Tensor) -> Tensor:
    return value.detach().clone().requires_grad_(True)
