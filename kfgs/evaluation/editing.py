"""Score edits: does an edit change its object, and nothing else? In pictures and on surfaces with known classes.

The toy room knows the class of every pixel and every surface (`make_toy_room`). So an edited cloud is compared with the cloud
before the edit, separately on the object and elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import kornia.color
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from .._check import ORIGIN
from .._origin import recounted
from ..cameras.camera import Camera
from ..gaussians import Gaussians
from ..splat import rasterize
from .edit_reports import RecolorReport, RemovalReport
from .scene_truth import SceneTruth
from .surface_density import surface_density

STEP = 8 / 255  # a channel that moves less is untouched: twice what 8-bit rounding and a JPEG would do
HUE = 20.0  # degrees
LEAST_LIGHT = 0.25  # share of a pixel's light that the object gave before the edit; of other pixels nothing can be said
LEAST_DENSITY = 0.05  # at a surface point before the edit, for the same reason
LEAST_CHROMA = 0.04  # ten 8-bit steps between the largest and the smallest channel: below, a hue is noise


def score_removal(
    before: Gaussians,
    after: Gaussians,
    scene: str | Path,
    name: str,
    *,
    split: str = "test",
    engine: str = "auto",
) -> RemovalReport:
    """Score the removal of a class (protocol `kfgs-removal/1`, see `REMOVAL`).

    A Gaussian shows the object if its centre stands nearer to the class's true surface than to any other. Depth cannot
    tell: a rug lies on its floor, and a picture hangs flat on its wall. So Gaussians that only moved to where another
    surface is nearest count as gone; how few of the class's pixels changed gives that away, unless it has a texture.

    Args:
        before: the colour field, with `sh`.
        after: the same field without the class.
        scene: a folder with exact labels and surfaces, as `make_toy_room` writes it, in whose frame both fields are.
        name: the class.
        split: which views are looked at.
        engine: see `composite`.

    Raises:
        FileNotFoundError: if the scene lacks labels or `surface.npz`.
        ValueError: if the scene has no such class, no view of the split shows it, or a field has no `sh`.
    """
    truth = SceneTruth.open(scene, name, split)
    pixels = {key: _Share() for key in ("gone", "changed", "shown", "untouched", "off_border")}
    points, of_class = truth.surface()
    owned = [_is_nearest(cloud, points, of_class) for cloud in (before, after)]
    for view in truth.views():
        old, new = (_picture(cloud, view.camera, engine).cpu() for cloud in (before, after))
        same = (new - old).abs().amax(-1) < STEP
        light = _light(before, owned[0], view.camera, engine)
        left = _light(after, owned[1], view.camera, engine)
        shown = light >= LEAST_LIGHT
        pixels["shown"].add(shown, among=view.inside)
        pixels["gone"].add(left < 0.5 * light, among=view.inside & shown)
        pixels["changed"].add(~same, among=view.inside & shown)
        pixels["untouched"].add(same, among=~view.inside)
        pixels["off_border"].add(same, among=view.far)
    density, rest = (surface_density(cloud, points) for cloud in (before, after))
    covered, lost = density >= LEAST_DENSITY, rest < 0.5 * density
    return RemovalReport(
        name=name,
        gone_pixels=pixels["gone"].value,
        changed_pixels=pixels["changed"].value,
        untouched_pixels=pixels["untouched"].value,
        untouched_off_border=pixels["off_border"].value,
        gone_points=_share(lost, among=covered & of_class),
        kept_points=_share(~lost, among=covered & ~of_class),
        measured_pixels=pixels["shown"].value,
        measured_points=_share(covered, among=of_class),
        pixels=truth.pixels,
        views=len(truth.indices),
    )


def score_recolor(
    before: Gaussians,
    after: Gaussians,
    scene: str | Path,
    name: str,
    rgb: Sequence[float],
    *,
    split: str = "test",
    engine: str = "auto",
) -> RecolorReport:
    """Score the recolouring of a class (protocol `kfgs-recolor/1`, see `RECOLOR`).

    Args:
        before: the colour field, with `sh`.
        after: the same field, recoloured.
        scene: a folder with labels of every view, as `make_toy_room` writes it, in whose frame both fields are.
        name: the class.
        rgb: the colour that was asked for, three numbers in [0, 1] that are not all alike: grey has no hue.
        split: which views are looked at.
        engine: see `composite`.

    Raises:
        FileNotFoundError: if the scene lacks labels.
        ValueError: if the scene has no such class, no view of the split shows it, `rgb` is no colour, or a field has no
            `sh`.
    """
    wanted = _check_color(rgb)
    truth = SceneTruth.open(scene, name, split)
    colored, right, right_before = _Share(), _Share(), _Share()
    outside, off_border = _MeanSquare(), _MeanSquare()
    for view in truth.views():
        old, new = (_picture(cloud, view.camera, engine).cpu() for cloud in (before, after))
        outside.add((new - old)[~view.inside])
        off_border.add((new - old)[view.far])
        for picture, share in ((old, right_before), (new, right)):
            has_hue = picture.amax(-1) - picture.amin(-1) >= LEAST_CHROMA
            turn = (_hue_degrees(picture) - _hue_degrees(wanted[None, None])).remainder(360)
            share.add(torch.minimum(turn, 360 - turn) <= HUE, among=view.inside & has_hue)
        colored.add(has_hue, among=view.inside)
    return RecolorReport(
        name=name,
        rgb=(float(rgb[0]), float(rgb[1]), float(rgb[2])),
        psnr_outside=outside.psnr,
        psnr_off_border=off_border.psnr,
        hue_inside=right.value,
        hue_before=right_before.value,
        measured_pixels=colored.value,
        pixels=truth.pixels,
        views=len(truth.indices),
    )


class _Share:
    """Of many, how many: counted over the views."""

    def __init__(self) -> None:
        self.hits, self.count = 0, 0

    def add(self, which: Tensor, *, among: Tensor) -> None:
        self.hits += int((which & among).sum())
        self.count += int(among.sum())

    @property
    def value(self) -> float:
        return self.hits / self.count if self.count else math.nan


def _share(which: Tensor, *, among: Tensor) -> float:
    share = _Share()
    share.add(which, among=among)
    return share.value


class _MeanSquare:
    """Mean of squared differences over all pixels of all views, for one PSNR."""

    def __init__(self) -> None:
        self.total, self.count = 0.0, 0

    def add(self, difference: Tensor) -> None:
        self.total += float(difference.double().square().sum())
        self.count += difference.numel()

    @property
    def psnr(self) -> float:
        if self.count == 0:
            return math.nan
        return -10 * math.log10(self.total / self.count) if self.total > 0 else math.inf


def _picture(cloud: Gaussians, camera: Camera, engine: str) -> Tensor:  # [H, W, 3] in [0, 1]
    if cloud.sh is None:
        raise ValueError(
            "before, after: expected colour fields with sh [N, K, 3], got None; pass the edited colour field"
        )
    return rasterize(cloud.detach().replace(features=None), camera, engine=engine).map.clamp(0, 1)


def _is_nearest(
    cloud: Gaussians,
    points: Tensor,  # [P, 3]
    of_class: Tensor,  # [P] bool
) -> Tensor:  # [N] bool
    """Which Gaussians stand nearer to the class's surface than to any other."""
    nearest = cKDTree(recounted(points, ORIGIN, cloud.origin).numpy()).query(cloud.means.detach().cpu().numpy())[1]
    return of_class[torch.from_numpy(nearest)]


def _light(cloud: Gaussians, owned: Tensor, camera: Camera, engine: str) -> Tensor:  # [H, W] in [0, 1]
    """How much of each pixel's light comes from some of the Gaussians."""
    shares = owned.to(cloud.means)[:, None]
    return rasterize(cloud.detach().replace(features=shares, sh=None), camera, engine=engine).map[..., 0].cpu()


def _hue_degrees(rgb: Tensor) -> Tensor:  # [H, W, 3] -> [H, W]
    return kornia.color.rgb_to_hsv(rgb.permute(2, 0, 1)[None])[0, 0].rad2deg()


def _check_color(rgb: Sequence[float]) -> Tensor:  # [3]
    color = torch.as_tensor(rgb, dtype=torch.float32)
    if color.shape != (3,) or not bool(((color >= 0) & (color <= 1)).all()):
        raise ValueError(f"rgb: expected three numbers in [0, 1], got {rgb!r}; divide 8-bit colours by 255")
    if float(color.max() - color.min()) < LEAST_CHROMA:
        raise ValueError(f"rgb: expected a colour with a hue, got the grey {rgb!r}; score another colour")
    return color
