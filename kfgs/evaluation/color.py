"""Score a colour field on unseen views: PSNR and SSIM under a named protocol."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..gaussians import Gaussians
from ..metrics import Score, psnr, ssim
from ..scenes import Scene
from ..splat.rasterize import render_color
from .report import plain

COLOR_PROTOCOL = (
    "kfgs-color/1: each view rendered at its picture's full size on black and clipped to [0, 1], not rounded; PSNR of the "
    "mean squared error over all channels of the recorded pixels, kornia's SSIM (Gaussian window 11x11, sigma 1.5, inside "
    "the picture) with unrecorded pixels black in both; masked pixels are not recorded, and what is transparent in a picture is "
    "black; mean over the views"
)


class ViewScore(NamedTuple):
    """The scores of one view."""

    name: str
    psnr: float
    """Decibels."""
    ssim: float


@dataclass(frozen=True, eq=False)
class ColorReport:
    """Scores of one colour field over the views of a split."""

    views: tuple[ViewScore, ...]
    psnr: Score
    """Mean over the views, decibels."""
    ssim: Score
    """Mean over the views."""

    def __str__(self) -> str:
        worst = min(self.views, key=lambda view: view.psnr)
        return (
            f"PSNR {self.psnr.value:.2f} dB, SSIM {self.ssim.value:.4f} over {len(self.views)} views, worst "
            f"{worst.psnr:.2f} dB ({worst.name}) ({self.psnr.protocol.split(':')[0]})"
        )

    def to_json(self) -> dict[str, Any]:
        """The scores as plain numbers; an infinite PSNR (equal pictures) is null."""
        views = {view.name: {"psnr": view.psnr, "ssim": view.ssim} for view in self.views}
        scores = {"protocol": self.psnr.protocol, "psnr": self.psnr.value, "ssim": self.ssim.value}
        return {name: plain(value) for name, value in {**scores, "views": views}.items()}


@torch.no_grad()
def score_views(
    gaussians: Gaussians,
    scene: Scene,
    split: str = "test",
    *,
    show: Callable[[str, Tensor, Tensor], None] | None = None,
) -> ColorReport:
    """Render the views of a split and compare them with the pictures that were taken (protocol `kfgs-color/1`).

    Args:
        gaussians: with colours (`sh`).
        scene: without lens distortion; its pictures are read one at a time.
        split: which views; those held out say how well the field generalises.
        show: called with the stem, the rendering [H, W, 3] and the picture [H, W, 3] of each view.

    Raises:
        ValueError: if the Gaussians carry no colours, a camera has distortion, or the split holds no view, or only masked pixels.
    """
    if gaussians.sh is None:
        raise ValueError(
            "gaussians: expected colours sh [N, K, 3], got None; pass a colour field, as fit_color makes it"
        )
    scores = []
    for i in scene.views(split):
        taken, known = scene.image(i).to(gaussians.means), scene.mask(i).to(gaussians.means.device)
        rendered = render_color(gaussians, scene.cameras[i])
        if show is not None:
            show(scene.stem(i), rendered, taken)
        if not bool(known.any()):  # masked as a whole
            continue
        inside = known[..., None]
        rendered, taken = torch.where(inside, rendered, 0), torch.where(inside, taken, 0)
        level = psnr(rendered[known][:, None], taken[known][:, None])
        scores.append(ViewScore(scene.stem(i), float(level), float(ssim(rendered, taken))))
    if not scores:
        raise ValueError(
            f"split: expected views with pixels that are not masked, got none in {split!r}; choose another split"
        )
    count = len(scores)
    return ColorReport(
        views=tuple(scores),
        psnr=Score("PSNR", sum(view.psnr for view in scores) / count, COLOR_PROTOCOL),
        ssim=Score("SSIM", sum(view.ssim for view in scores) / count, COLOR_PROTOCOL),
    )
