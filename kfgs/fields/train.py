"""Fit a cloud of Gaussians to posed maps: render a view, compare, step, densify (Sec. 3.2 on top of 3DGS)."""

from __future__ import annotations

import hashlib
import io
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm.auto import tqdm

from .._arrays import reading
from .._card import short_repr
from .._check import ORIGIN, Progress, as_progress, as_tensor
from .._files import as_path, atomic_path, digest_value
from ..cameras import Camera, as_cameras
from ..cameras.paths import camera_extent
from ..gaussians import Gaussians, check_gaussians
from ..splat import rasterize
from .loss import ColorLoss, Loss, l1_loss
from .optimizer import FieldOptimizer, GradientStatistics, densify, to_gaussians, to_raw
from .options import Densify, Training, check_extent
from .working_maps import shrink_camera, shrink_map

AGAIN = "delete it to start again, or give another path"  # what to do about a checkpoint that does not fit


@dataclass(frozen=True, eq=False)
class FieldFit:
    """A fitted cloud, and the history of its training.

    Each row of `history` holds `step`, `loss` (the mean since the row before), `count` (Gaussians) and `seconds`
    (training time so far, earlier runs of a resumed fit included).
    """

    gaussians: Gaussians
    history: list[dict[str, Any]]

    __repr__ = short_repr


def fit_field(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    targets: Sequence[Tensor],  # C maps [h, w, D]
    training: Training | None = None,
    *,
    loss: Loss = l1_loss,
    generator: torch.Generator | None = None,
    progress: Progress = False,
    checkpoint: str | Path | None = None,
) -> FieldFit:
    """Train Gaussians until their renderings match the targets (Eq. 4), growing and pruning them on the way.

    Each step uses one view, in random order; each view is used once before any is repeated.

    Args:
        gaussians: the start, with features or colours (of both, features are trained); not changed. They decide dtype and
            device of the fit. Without an origin they are counted from that of the cameras, as the points of a scene are.
        cameras: C posed cameras without distortion.
        targets: one map per camera, of any size, NaN where nothing is known; read one at a time, so they may live on disk;
            a GPU keeps those that it has read, as long as half of its memory is free.
        training: the paper's values when not given. If its `extent` is None, that of the cameras takes its place:
            1.1 times their largest distance from their mean.
        loss: compares a rendered map, its alpha and the target. For colours, `ColorLoss`.
        generator: draws the views' order and the places of split Gaussians; None stands for seed 0.
        progress: True shows a bar. A function is called with each new row of the history; to stop early, raise from it; a
            checkpoint stays behind.
        checkpoint: a file that is written every `checkpoint_every` steps and at the end. If it exists, the fit
            continues from it, and its result is bit for bit that of an undisturbed run (on one machine's CPU; a GPU adds
            gradients up in no fixed order).

    Raises:
        ValueError: if the cameras' extent is 0, counts or shapes disagree, a camera has distortion, the checkpoint belongs
            to another fit, or no Gaussian is left.
        FloatingPointError: if the loss is no longer finite.
        FileNotFoundError: if something else deletes the checkpoint's folder meanwhile; noticed at the next checkpoint.
    """
    training, progress = training or Training(), as_progress(progress)
    check_gaussians(gaussians)
    if not len(gaussians) or (gaussians.features is None and gaussians.sh is None):
        got = f"{gaussians!r}; gaussians_from_points makes them"
        raise ValueError(f"gaussians: expected some with features [N, d] or sh [N, K, 3], got {got}")
    if not (cameras := as_cameras(cameras)) or len(cameras) != len(targets):
        got = f"{len(targets)}; pass the views that have maps"
        raise ValueError(f"targets: expected one map per camera ({len(cameras)}, at least one), got {got}")
    if gaussians.origin == ORIGIN:
        gaussians = gaussians.replace(origin=cameras[0].origin)
    cameras = [camera.with_origin(gaussians.origin) for camera in cameras]
    if training.extent is None:
        training = replace(training, extent=float(check_extent(camera_extent(cameras, gaussians.means))))
    trainer = Trainer(gaussians, cameras, targets, training, loss, generator or torch.Generator().manual_seed(0))
    path = as_path(checkpoint) if checkpoint is not None else None
    if path is not None:
        identity = trainer.identity()
        if path.exists():
            trainer.restore_(read_checkpoint(path, identity))
        path.parent.mkdir(parents=True, exist_ok=True)
    with tqdm(
        total=training.steps, initial=trainer.step, disable=progress is not True, desc="field", unit="step"
    ) as bar:
        while trainer.step < training.steps:
            row = trainer.advance_()
            bar.update()
            if row is not None:
                bar.set_postfix(loss=f"{row['loss']:.4f}", Gaussians=row["count"], refresh=False)
                if callable(progress):
                    progress(dict(row))
            last = trainer.step == training.steps
            if path is not None and (last or trainer.step % training.checkpoint_every == 0):
                write_checkpoint(path, trainer.state() | {"identity": identity})
    return FieldFit(trainer.gaussians().detach(), trainer.history)


class Trainer:
    """Gaussians in training, with everything that the next step depends on."""

    def __init__(
        self,
        gaussians: Gaussians,
        cameras: Sequence[Camera],
        targets: Sequence[Tensor],
        training: Training,
        loss: Loss,
        generator: torch.Generator,
    ) -> None:
        """Prepare step 1; the arguments are those of `fit_field`, checked, and the extent is known."""
        self._cameras, self._targets, self._loss = cameras, targets, loss
        self._training, self._generator = training, generator
        self._render_cameras: dict[tuple[int, bool], Camera] = {}
        self._on_gpu: dict[int, Tensor] = {}  # targets that stay there, as long as half of its memory is free
        self._start = gaussians  # also of a resumed fit
        self.optimizer = FieldOptimizer(to_raw(gaussians), training)
        self._channels = 3 if gaussians.features is None else gaussians.features.shape[1]
        self._sh_start = 0 if gaussians.features is not None or gaussians.sh is None else used_sh_degree(gaussians.sh)
        self.statistics = GradientStatistics.zeros(gaussians.means)
        self.history: list[dict[str, Any]] = []
        self._queue: list[int] = []  # views still to come in this epoch, last first
        self.step, self._losses, self._seconds = 0, 0.0, 0.0

    def gaussians(self, sh_degree: int | None = None) -> Gaussians:
        """The cloud as it is now, differentiable; of colours, only harmonics up to `sh_degree` (None: all)."""
        return to_gaussians(self.optimizer.raw, self._start, sh_degree)

    def advance_(self) -> dict[str, Any] | None:
        """One step of the optimisation; returns the new row of the history, if there is one."""
        started = time.perf_counter()
        self.step += 1
        options = self._training.densify
        growing = options is not None and self.step < options.stop
        self._learn_(growing)
        if options is not None and growing:
            if self.step > options.start and self.step % options.every == 0:
                self._densify_(options)
            if options.reset_every and self.step % options.reset_every == 0:
                self.optimizer.lower_opacities_()
        self._seconds += time.perf_counter() - started
        if self.step % self._training.report_every and self.step != self._training.steps:
            return None
        since = self.step - (self.history[-1]["step"] if self.history else 0)
        count = len(self.optimizer.raw["means"])
        row = {"step": self.step, "loss": self._losses / since, "count": count, "seconds": round(self._seconds, 3)}
        self.history.append(row)
        self._losses = 0.0
        return row

    def _learn_(self, growing: bool) -> None:
        """Follow the gradients of the next view; while `growing`, keep those of the places in the picture."""
        if not self._queue:
            device = self._generator.device
            self._queue = torch.randperm(len(self._cameras), generator=self._generator, device=device).tolist()
        view, training = self._queue.pop(), self._training
        target, half = self._target(view)
        camera = self._camera(view, target, half)
        every = training.sh_degree_every
        gaussians = self.gaussians(self._sh_start + self.step // every if every else None)
        rendering = rasterize(gaussians, camera, engine=training.engine)
        means2d = rendering.projected.means2d
        if means2d.requires_grad:
            means2d.retain_grad()
        loss = self._loss(rendering.map, rendering.alpha, target)
        if loss.requires_grad:  # not so when the view shows no Gaussian
            loss.backward()
            if growing and means2d.grad is not None:
                self.statistics.add_(rendering.projected.index, means2d.grad, camera.size)
        value = float(loss.detach())  # waits for a GPU, which has its work by now
        if not math.isfinite(value):
            raise FloatingPointError(
                f"loss: expected a finite number at step {self.step}, got {value} (view {camera.name!r}); "
                "check the targets for infinities, or lower the learning rates"
            )
        self._losses += value
        self.optimizer.step_(self.step)

    def _densify_(self, options: Densify) -> None:
        assert self._training.extent is not None
        grown = densify(
            self.optimizer.raw,
            self.statistics.mean(),
            options,
            extent=self._training.extent,
            prune_large=0 < options.reset_every < self.step,
            generator=self._generator,
        )
        if len(grown.parent) == 0:
            raise ValueError(
                f"training: expected some Gaussian to outlast pruning, got none at step {self.step}; raise prune_extent "
                f"(now {options.prune_extent}) or lower prune_opacity ({options.prune_opacity}), or check extent"
            )
        self.optimizer.replace_(*grown)
        self.statistics = GradientStatistics.zeros(grown.raw["means"])

    def _target(self, view: int) -> tuple[Tensor, bool]:  # [h, w, D]
        """The map of a view, and whether it was halved."""
        given = self._on_gpu[view] if view in self._on_gpu else self._targets[view]
        target, size = as_tensor(f"targets[{view}]", given, floating=True), self._cameras[view].size
        channels = self._channels
        clear = isinstance(self._loss, ColorLoss) and target.shape[2:] == (channels + 1,)
        if target.ndim != 3 or (target.shape[2] != channels and not clear):
            raise ValueError(
                f"targets[{view}]: expected [h, w, D] with D = {channels} (from gaussians), got {tuple(target.shape)}; "
                "start from gaussians_from_points(points, D)"
            )
        target = target.to(self._start.means)
        if target.is_cuda and view not in self._on_gpu:
            free, memory = torch.cuda.mem_get_info(target.device)
            if free > memory / 2:
                self._on_gpu[view] = target
        half = self.step <= self._training.half_until and min(size) >= 2
        if half and tuple(target.shape[:2]) != size:
            raise ValueError(
                f"targets[{view}]: expected {size} pixels as the camera has (half_until asks for it), got "
                f"{tuple(target.shape[:2])}; resize the camera, or leave half_until at 0"
            )
        return shrink_map(target, 2) if half else target, half

    def _camera(self, view: int, target: Tensor, half: bool) -> Camera:
        """The camera to render with; cached, because checking a new camera takes longer than using it."""
        if (view, half) not in self._render_cameras:
            camera, scale = self._cameras[view].to(self._start.means), self._training.render_scale
            if scale is not None:
                height, width = (max(1, round(n * scale)) for n in target.shape[:2])
                camera = camera.resized(min(height, camera.height), min(width, camera.width))
            self._render_cameras[view, half] = shrink_camera(camera, 2) if half else camera
        return self._render_cameras[view, half]

    def identity(self) -> str:
        """A digest of the inputs of the fit, before its first step. Of the targets, only their number and the first map count."""
        start, options = self._start, asdict(replace(self._training, checkpoint_every=1))
        views = [tensor for camera in self._cameras for tensor in (camera.viewmat, camera.K)]
        first = as_tensor("targets[0]", self._targets[0], floating=True)
        tensors = digest_tensors(*self.optimizer.raw.values(), *views, first, self._generator.get_state())
        loss = getattr(self._loss, "__qualname__", None) or repr(self._loss)
        sizes = [len(self._targets), *((camera.size, camera.near) for camera in self._cameras)]
        return digest_value([tensors, start.origin, start.antialiased, sizes, options, loss])

    def state(self) -> dict[str, Any]:
        """Everything that `restore_` needs: tensors, numbers, lists and dictionaries."""
        return {
            "raw": {name: value.detach() for name, value in self.optimizer.raw.items()},
            "adam": self.optimizer.adam.state_dict()["state"],
            "statistics": self.statistics._asdict(),
            "generator": self._generator.get_state(),
            "progress": [self.step, self._queue, self.history, self._losses, self._seconds],
        }

    def restore_(self, state: dict[str, Any]) -> None:
        """Continue from a `state`; also restores that of the fit's generator."""
        means = self._start.means
        self.optimizer = FieldOptimizer({name: value.to(means) for name, value in state["raw"].items()}, self._training)
        self.optimizer.adam.load_state_dict(self.optimizer.adam.state_dict() | {"state": state["adam"]})
        self.statistics = GradientStatistics(*(value.to(means) for value in state["statistics"].values()))
        self._generator.set_state(state["generator"])
        self.step, self._queue, self.history, self._losses, self._seconds = state["progress"]


def used_sh_degree(sh: Tensor) -> int:  # [N, K, 3]
    """Highest degree with a coefficient other than 0."""
    filled = sh[:, 1:].ne(0).any(dim=2).any(dim=0).nonzero()  # [K - 1]
    return math.isqrt(int(filled.max()) + 1) if len(filled) else 0


def digest_tensors(*tensors: Tensor) -> str:
    """SHA-256 over shapes, dtypes and values, in hexadecimal."""
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(f"{tuple(tensor.shape)}{tensor.dtype}".encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def write_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write the file; it is whole or absent. Its folder was made at the start and is not made again."""
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path.parent}: expected this folder to stay while Gaussians are trained; start again")
    buffer = io.BytesIO()  # torch.save reports a full disk as a bug of its own, with a traceback
    torch.save(state, buffer)
    with atomic_path(path) as temporary:
        temporary.write_bytes(buffer.getbuffer())


def read_checkpoint(path: Path, identity: str) -> dict[str, Any]:
    """Read the file; a ValueError if it is damaged, or belongs to a fit with other inputs."""
    with reading(path, "a checkpoint of kfgs", AGAIN), path.open("rb") as file:
        state = dict(torch.load(file, map_location="cpu", weights_only=True))
        known = state["identity"]
    if known != identity:
        got = f"one with other Gaussians, views, options, loss or seed; {AGAIN}"
        raise ValueError(f"checkpoint: expected one of this very fit at {path}, got {got}")
    return state
