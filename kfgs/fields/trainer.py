"""The state of one fit and its single step; `fit_field` drives it."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from .._check import as_tensor
from ..cameras import Camera
from ..gaussians import FACTS
from ..splat import rasterize
from .checkpoint import Checkpoint
from .config import FieldConfig
from .densify import GradientStatistics, densify, lowered_opacities
from .loss import ColorLoss, Loss, l1_loss
from .optimizer import FieldOptimizer
from .params import GaussianParams
from .working_maps import shrink_camera, shrink_map

WARM_UP_SIZE = 16  # pixels: more than a window of SSIM


class Trainer:
    """Gaussians in training, with everything that the next step depends on."""

    def __init__(
        self,
        params: GaussianParams,
        cameras: Sequence[Camera],
        targets: Sequence[Tensor],
        config: FieldConfig,
        extent: float,
        loss: Loss,
        generator: torch.Generator,
    ) -> None:
        """Prepare step 1; the arguments are those of `fit_field`, checked."""
        self._cameras, self._targets, self._loss = cameras, targets, loss
        self._config, self._extent, self._generator = config, extent, generator
        self._render_cameras: dict[tuple[int, int], Camera] = {}
        self._sh_start = params.used_sh_degree()  # of the start, so a resumed fit finds the same: no part of a snapshot
        self.optimizer = FieldOptimizer(params, config, extent=extent)
        self.statistics = GradientStatistics.zeros(params)
        self.history: list[dict[str, Any]] = []
        self.step = 0
        self._queue: list[int] = []  # views still to come in this epoch, last first
        self._losses, self._seconds = 0.0, 0.0

    def advance_(self) -> dict[str, Any] | None:
        """One step of the optimisation; returns the new row of the history, if there is one."""
        started = time.perf_counter()
        config = self._config
        self.step += 1
        self._learn_()
        if self.step < config.densify_until:
            if self.step > config.densify_from and self.step % config.densify_every == 0:
                self._densify_()
            if config.reset_every and self.step % config.reset_every == 0:
                logits = self.optimizer.params.logit_opacities
                self.optimizer.set_opacities_(lowered_opacities(logits, config.reset_opacity))
        self._seconds += time.perf_counter() - started
        return self._report_() if self.step % config.report_every == 0 or self.step == config.steps else None

    def warm_up(self) -> None:
        """Compute the gradients of a tiny view and forget them: kernels are compiled or loaded now, not in step 1."""
        params = self.optimizer.params
        camera = self._cameras[0].to(params.means).resized(WARM_UP_SIZE, WARM_UP_SIZE)
        rendering = rasterize(params.activated(), camera, engine=self._config.engine)
        loss = self._loss if isinstance(self._loss, ColorLoss) else l1_loss  # not a caller's own one: it may keep count
        value = loss(rendering.map, rendering.alpha, torch.zeros_like(rendering.map))
        if value.requires_grad:
            value.backward()
        self.optimizer.forget_()

    def _learn_(self) -> None:
        """Average the gradients of the views of this step, in their order, and follow them."""
        views, params = [self._next_view() for _ in range(self._config.views_per_step)], self.optimizer.params
        gradients: dict[str, Tensor] = {}
        for part in map(self._look, views):
            self._losses += float(part.pop("loss")) / len(views)
            if "pixels" in part:
                index, moved, (height, width) = part.pop("index"), part.pop("pixels"), part.pop("size").tolist()
                self.statistics.add_(index, moved, (height, width))
            for name, value in part.items():
                gradients[name] = gradients[name] + value if name in gradients else value
        for name, value in params.to_tensors().items():
            if name in gradients:
                value.grad = gradients[name] if len(views) == 1 else gradients[name] / len(views)
        self.optimizer.step_(self.step)

    def _look(self, view: int) -> dict[str, Tensor]:
        """Loss and gradients of one view: of the parameters by name, and of the places in the picture that densifying needs."""
        params = self.optimizer.params
        target = self._target(view)
        camera = self._camera(view, target)
        gaussians = params.activated(self._config.sh_degree(self.step, self._sh_start))
        rendering = rasterize(gaussians, camera, engine=self._config.engine)
        means2d = rendering.projected.means2d
        if means2d.requires_grad:
            means2d.retain_grad()
        loss = self._loss(rendering.map, rendering.alpha, target)
        value = float(loss.detach())
        if not math.isfinite(value):
            raise FloatingPointError(
                f"loss: expected a finite number at step {self.step}, got {value} (view {camera.name!r}); "
                "check the targets for infinities, or lower the learning rates"
            )
        found = {"loss": torch.tensor(value, dtype=torch.float64)}
        if loss.requires_grad:  # not so when the view shows no Gaussian
            loss.backward()
            if means2d.grad is not None and self.step < self._config.densify_until:
                size = camera.size if self._config.densify_gradient_size == "render" else tuple(target.shape[:2])
                found |= {"index": rendering.projected.index, "pixels": means2d.grad, "size": torch.tensor(size)}
            found |= {name: one.grad for name, one in params.to_tensors().items() if one.grad is not None}
            self.optimizer.forget_()
        return found

    def _densify_(self) -> None:
        config = self._config
        grown = densify(
            self.optimizer.params,
            self.statistics.mean(),
            config,
            extent=self._extent,
            prune_large=0 < config.reset_every < self.step,
            generator=self._generator,
        )
        if len(grown.params) == 0:
            raise ValueError(
                f"config: expected some Gaussian to outlast pruning, got none at step {self.step}; raise prune_extent "
                f"(now {config.prune_extent}) or lower prune_opacity ({config.prune_opacity}), or check extent"
            )
        self.optimizer.replace_(*grown)
        self.statistics = GradientStatistics.zeros(grown.params)

    def _report_(self) -> dict[str, Any]:
        since = self.step - (self.history[-1]["step"] if self.history else 0)
        count = len(self.optimizer.params)
        row = {"step": self.step, "loss": self._losses / since, "count": count, "seconds": round(self._seconds, 3)}
        self.history.append(row)
        self._losses = 0.0
        return row

    def _next_view(self) -> int:
        if not self._queue:
            device = self._generator.device
            self._queue = torch.randperm(len(self._cameras), generator=self._generator, device=device).tolist()
        return self._queue.pop()

    def _target(self, view: int) -> Tensor:  # [h, w, D]
        target = as_tensor(f"targets[{view}]", self._targets[view], floating=True)
        channels = self.optimizer.params.channels
        clear = isinstance(self._loss, ColorLoss) and target.ndim == 3 and target.shape[2] == channels + 1
        if target.ndim != 3 or (target.shape[2] != channels and not clear):
            raise ValueError(
                f"targets[{view}]: expected [h, w, D] with D = {channels} (from params), got {tuple(target.shape)}; "
                "start from GaussianParams.from_points(points, D)"
            )
        target = target.to(self.optimizer.params.means)
        divisor = self._divisor(view)
        if divisor > 1:
            if tuple(target.shape[:2]) != self._cameras[view].size:
                raise ValueError(
                    f"targets[{view}]: expected {self._cameras[view].size} pixels as the camera has (config.coarse asks "
                    f"for it), got {tuple(target.shape[:2])}; resize the camera, or leave coarse empty"
                )
            target = shrink_map(target, divisor)
        return target

    def _divisor(self, view: int) -> int:
        return min(self._config.divisor(self.step), *self._cameras[view].size)

    def _camera(self, view: int, target: Tensor) -> Camera:
        """The camera to render with; cached, because checking a new camera takes longer than using it."""
        divisor = self._divisor(view)
        if (view, divisor) not in self._render_cameras:
            camera = self._cameras[view].to(self.optimizer.params.means)
            if self._config.render_scale is not None:
                height, width = (max(1, round(n * self._config.render_scale)) for n in target.shape[:2])
                camera = camera.resized(min(height, camera.height), min(width, camera.width))
            self._render_cameras[view, divisor] = camera if divisor == 1 else shrink_camera(camera, divisor)
        return self._render_cameras[view, divisor]

    def snapshot(self) -> Checkpoint:
        """Everything that `restore_` needs."""
        tensors = {f"params.{name}": value for name, value in self.optimizer.params.to_tensors().items()}
        tensors |= {f"adam.{name}": value for name, value in self.optimizer.state_tensors().items()}
        tensors |= {f"statistics.{name}": value for name, value in self.statistics._asdict().items()}
        tensors["generator"] = self._generator.get_state()
        state = {
            "step": self.step,
            "queue": self._queue,
            "losses": self._losses,
            "seconds": self._seconds,
            "history": self.history,
        }
        return Checkpoint(tensors, state)

    def restore_(self, checkpoint: Checkpoint) -> None:
        """Continue from a snapshot; also restores the state of the fit's generator."""
        device = self.optimizer.params.means.device
        parts: dict[str, dict[str, Tensor]] = {"params": {}, "adam": {}, "statistics": {}}
        for name, value in checkpoint.tensors.items():
            if name != "generator":
                kind, rest = name.split(".", 1)
                parts[kind][rest] = value.to(device)
        facts: dict[str, Any] = {name: getattr(self.optimizer.params, name) for name in FACTS}
        params = replace(GaussianParams.from_tensors(parts["params"]), **facts)
        self.optimizer = FieldOptimizer(params, self._config, extent=self._extent)
        self.optimizer.load_state_(parts["adam"])
        self.statistics = GradientStatistics(**parts["statistics"])
        self._generator.set_state(checkpoint.tensors["generator"])
        state = checkpoint.state
        self.step, self._queue, self.history = state["step"], state["queue"], state["history"]
        self._losses, self._seconds = state["losses"], state["seconds"]
