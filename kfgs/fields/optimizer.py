"""Adam for the raw values of a cloud; the number of Gaussians may change during training."""

from __future__ import annotations

import torch
from torch import Tensor

from .config import FieldConfig
from .params import GaussianParams

_MOMENTS = ("exp_avg", "exp_avg_sq")


class FieldOptimizer:
    """Adam with one learning rate per kind of parameter, and moments that stay with their Gaussians.

    `params` holds the leaf tensors that are being trained. Growing or pruning keeps the moments of every Gaussian that
    stays; new ones start at 0 (as in 3DGS). torch's Adam does the arithmetic, fused.
    """

    def __init__(self, params: GaussianParams, config: FieldConfig, *, extent: float) -> None:
        """Copy `params` and prepare Adam; the learning rate of the means is in units of `extent`."""
        self.params = params.map(_leaf)
        self._config, self._extent = config, extent
        rates = {
            "means": config.means_lr * extent,
            "quats": config.quats_lr,
            "log_scales": config.scales_lr,
            "logit_opacities": config.opacities_lr,
            "features": config.features_lr,
            "sh0": config.sh0_lr,
            "sh_rest": config.sh_rest_lr,
        }
        groups = [
            {"params": [value], "lr": rates[name], "name": name} for name, value in self.params.to_tensors().items()
        ]
        self._adam = torch.optim.Adam(groups, eps=config.adam_eps, fused=True)
        self._groups = {group["name"]: group for group in self._adam.param_groups}
        self._rates = rates

    def means_lr(self, step: int) -> float:
        """Learning rate of the means: from `means_lr` to `means_lr_final` times the extent, exponentially in the step."""
        config, t = self._config, step / self._config.steps
        return config.means_lr ** (1 - t) * config.means_lr_final**t * self._extent

    def step_(self, step: int) -> None:
        """Apply the gradients of step number `step`, then forget them."""
        config = self._config
        factor = config.rates_final ** max(0.0, 2 * step / config.steps - 1)
        for name, group in self._groups.items():
            group["lr"] = self.means_lr(step) if name == "means" else self._rates[name] * factor
        self._adam.step()
        self.forget_()

    def forget_(self) -> None:
        """Drop the gradients."""
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
            old = self._groups[name]["params"][0]
            state = self._adam.state.pop(old, {})
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
        state = self._adam.state.get(leaf, {})
        for moment in _MOMENTS:
            if moment in state:
                state[moment].zero_()

    def state_tensors(self) -> dict[str, Tensor]:
        """Moments and step counts by name, e.g. `means.exp_avg`; empty before the first step."""
        found = {}
        for name, value in self.params.to_tensors().items():
            for key, entry in self._adam.state.get(value, {}).items():
                found[f"{name}.{key}"] = entry
        return found

    def load_state_(self, state: dict[str, Tensor]) -> None:
        """Continue from the result of `state_tensors`."""
        for key, entry in state.items():
            name, moment = key.split(".")
            self._adam.state[self.params.to_tensors()[name]][moment] = entry.clone()


def _leaf(value: Tensor) -> Tensor:
    return value.detach().clone().requires_grad_(True)
