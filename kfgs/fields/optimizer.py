"""Adam for the raw values of a cloud; the number of Gaussians may change during training."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from .params import GaussianParams
from .training import Training

_MOMENTS = ("exp_avg", "exp_avg_sq")


class FieldOptimizer:
    """torch's fused Adam with one learning rate per kind of parameter, and moments that stay with their Gaussians.

    `params` holds the leaf tensors that are being trained. Growing or pruning keeps the moments of every Gaussian that
    stays; new ones start at 0 (as in 3DGS).
    """

    def __init__(self, params: GaussianParams, training: Training, *, extent: float) -> None:
        """Copy `params` and prepare Adam; the learning rate of the means is in units of `extent`."""
        self.params = params.map(_leaf)
        self._training, self._extent, rates = training, extent, training.rates
        self._rates = {
            "means": rates.means * extent,
            "quats": rates.quats,
            "log_scales": rates.scales,
            "logit_opacities": rates.opacities,
            "features": rates.features,
            "sh0": rates.sh0,
            "sh_rest": rates.sh_rest,
        }
        tensors = self.params.to_tensors().items()
        groups = [{"params": [value], "lr": self._rates[name], "name": name} for name, value in tensors]
        self._adam = torch.optim.Adam(groups, eps=rates.adam_eps, fused=True)
        self._groups = {group["name"]: group for group in self._adam.param_groups}

    def means_lr(self, step: int) -> float:
        """Learning rate of the means: from `rates.means` to `means_final` times the extent, exponentially in the step."""
        rates, t = self._training.rates, step / self._training.steps
        return rates.means ** (1 - t) * rates.means_final**t * self._extent

    def step_(self, step: int) -> None:
        """Apply the gradients of step number `step`, then forget them."""
        factor = self._training.rates.final ** max(0.0, 2 * step / self._training.steps - 1)
        for name, group in self._groups.items():
            group["lr"] = self.means_lr(step) if name == "means" else self._rates[name] * factor
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)

    def replace_(
        self,
        params: GaussianParams,  # N' Gaussians
        source: Tensor,  # [N'] int64
        fresh: Tensor,  # [N'] bool
    ) -> None:
        """Train `params` from now on: row i takes the moments of old row `source[i]`, or zeros where `fresh[i]`."""
        self.params = params.map(_leaf)
        for name, value in self.params.to_tensors().items():
            state = self._adam.state.pop(self._groups[name]["params"][0], {})
            for moment in _MOMENTS:
                if moment in state:
                    state[moment] = state[moment][source]
                    state[moment][fresh] = 0
            self._groups[name]["params"] = [value]
            if state:
                self._adam.state[value] = state

    def set_opacities_(self, logit_opacities: Tensor) -> None:  # [N]
        """Exchange the opacities and forget their moments, which belong to the old values."""
        leaf = self.params.logit_opacities
        leaf.data.copy_(logit_opacities)
        for moment in _MOMENTS:
            if moment in self._adam.state.get(leaf, {}):
                self._adam.state[leaf][moment].zero_()

    def state(self) -> dict[str, Any]:
        """Moments and step counts of Adam; empty before the first step."""
        return dict(self._adam.state_dict()["state"])

    def load_state_(self, state: dict[str, Any]) -> None:
        """Continue from the result of `state`, for these `params`."""
        copied = {i: {name: value.clone() for name, value in part.items()} for i, part in state.items()}
        self._adam.load_state_dict(self._adam.state_dict() | {"state": copied})
        self._groups = {group["name"]: group for group in self._adam.param_groups}  # Adam makes new ones


def _leaf(value: Tensor) -> Tensor:
    return value.detach().clone().requires_grad_(True)
