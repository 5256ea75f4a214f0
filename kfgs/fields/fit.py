"""Fit a cloud of Gaussians to posed maps: render a view, compare, step, densify (Sec. 3.2 on top of 3DGS)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm.auto import tqdm

from .._card import short_repr
from .._check import ORIGIN
from .._files import as_path
from .._progress import Progress, as_progress
from ..cameras import Camera
from ..cameras.bounds import camera_extent
from .checkpoint import identify_fit, read_checkpoint, write_checkpoint
from .config import FieldConfig, check_extent
from .loss import Loss, l1_loss
from .params import GaussianParams
from .trainer import Trainer


@dataclass(frozen=True, eq=False)
class FieldFit:
    """A fitted cloud, and the history of its training.

    Each row of `history` holds `step`, `loss` (the mean since the row before), `count` (Gaussians) and `seconds`
    (training time so far, earlier runs of a resumed fit included).
    """

    params: GaussianParams
    history: list[dict[str, Any]]

    __repr__ = short_repr


def fit_field(
    params: GaussianParams,
    cameras: Sequence[Camera],
    targets: Sequence[Tensor],  # C maps [h, w, D]
    config: FieldConfig | None = None,
    *,
    loss: Loss = l1_loss,
    generator: torch.Generator | None = None,
    progress: Progress = False,
    checkpoint: str | Path | None = None,
) -> FieldFit:
    """Train Gaussians until their renderings match the targets (Eq. 4), growing and pruning them on the way.

    Each step uses `config.views_per_step` views, in random order; each view is used once before any is repeated.

    Args:
        params: the start; not changed. They decide dtype and device of the fit. Without an origin they are counted from that
            of the cameras, as the points of a scene are.
        cameras: C posed cameras without distortion.
        targets: one map per camera, of any size, NaN where nothing is known (`l1_loss`); read one at a time
            and only by `len` and index, so they may live on disk.
        config: the paper's values when not given. If its `extent` is None, the extent of `cameras` takes its place, which is
            1.1 times their largest distance from their mean.
        loss: compares a rendered map, its alpha and the target. For colours, `ColorLoss`.
        generator: draws the views' order and the places of split Gaussians; None stands for seed 0.
        progress: True shows a bar with loss, number of Gaussians and time left. A function is called with each new row of
            the history. To stop early, raise from it; a checkpoint stays behind.
        checkpoint: a file that is written every `checkpoint_every` steps and at the end. If it exists, the fit
            continues from it, and its result is bit for bit that of an undisturbed run (on one machine's CPU; a GPU adds
            gradients up in no fixed order).

    Returns:
        The fitted params, and the history.

    Raises:
        TypeError: if `params`, a target or `progress` has another type.
        ValueError: if the cameras' extent is 0 or not finite, counts or shapes disagree, a camera has distortion, the
            checkpoint belongs to another fit, or no Gaussian is left.
        FloatingPointError: if the loss is no longer finite.
        FileNotFoundError: if something else deletes the checkpoint's folder meanwhile; noticed at the next checkpoint.
    """
    config, progress = config or FieldConfig(), as_progress(progress)
    generator = generator or torch.Generator().manual_seed(0)
    _check_views(params, cameras, targets)
    if params.origin == ORIGIN:
        params = replace(params, origin=cameras[0].origin)
    cameras = [camera.with_origin(params.origin) for camera in cameras]
    extent = check_extent(camera_extent(cameras, params.means)) if config.extent is None else config.extent
    trainer = Trainer(params, cameras, targets, config, extent, loss, generator)
    path, identity = (as_path(checkpoint) if checkpoint is not None else None), {}
    if path is not None:
        others = {"extent": float(extent), "loss": getattr(loss, "__qualname__", None) or repr(loss)}
        identity = identify_fit(params, cameras, targets, config, generator=generator, others=others)
        saved = read_checkpoint(path, identity)
        if saved is not None:
            trainer.restore_(saved)
        path.parent.mkdir(parents=True, exist_ok=True)
    if trainer.step < config.steps:
        trainer.warm_up()
    with tqdm(total=config.steps, initial=trainer.step, disable=progress is not True, desc="field", unit="step") as bar:
        while trainer.step < config.steps:
            row = trainer.advance_()
            bar.update()
            if row is not None:
                bar.set_postfix(loss=f"{row['loss']:.4f}", Gaussians=row["count"], refresh=False)
                if callable(progress):
                    progress(dict(row))
            if path is not None and (trainer.step % config.checkpoint_every == 0 or trainer.step == config.steps):
                write_checkpoint(path, trainer.snapshot(), identity)
    return FieldFit(trainer.optimizer.params.map(torch.Tensor.detach), trainer.history)


def _check_views(params: GaussianParams, cameras: Sequence[Camera], targets: Sequence[Tensor]) -> None:
    if not isinstance(params, GaussianParams):
        hint = "GaussianParams.from_gaussians or GaussianParams.from_points makes them"
        raise TypeError(f"params: expected GaussianParams, got {type(params).__name__}; {hint}")
    if len(params) == 0:
        raise ValueError("params: expected at least one Gaussian, got none; start from GaussianParams.from_points")
    if len(cameras) == 0 or len(cameras) != len(targets):
        raise ValueError(
            f"targets: expected one map per camera ({len(cameras)}, at least one), got {len(targets)}; "
            "pass the views that have maps"
        )
    for camera in cameras:
        if camera.distortion is not None:
            raise ValueError(
                f"cameras: expected cameras without distortion, got {camera.distortion.model} (camera {camera.name!r}); "
                "undistort the images first with kfgs.cameras.undistort, which returns the camera to use"
            )
