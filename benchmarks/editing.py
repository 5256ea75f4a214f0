"""Score edits: does an edit change its object, and nothing else? In pictures and on surfaces with known classes.

The toy room knows the class of every pixel and every surface (`make_toy_room`). So an edited cloud is compared with the cloud
before the edit, separately on the object and elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import kornia.color
import kornia.metrics
import numpy as np
import torch
from PIL import Image
from scipy.spatial import cKDTree
from surface_density import surface_density
from torch import Tensor

from kfgs._check import ORIGIN
from kfgs._files import as_path, read_json
from kfgs._origin import recounted
from kfgs.cameras import Camera
from kfgs.evaluation import find_points
from kfgs.evaluation.label_pictures import load_label_map
from kfgs.gaussians import Gaussians
from kfgs.scenes import Scene, load_scene
from kfgs.splat import rasterize
from kfgs.toy.patterns import Noise
from kfgs.toy.render import render
from kfgs.toy.room import build_room

REMOVAL = (
    "kfgs-removal/1: held-out views of a scene with exact labels and surfaces. A Gaussian shows the class if its centre is "
    "nearest to the class's surface. Pixels of the class that such Gaussians gave at least 1/4 of their light: gone = less "
    "than half of that light is left; changed = some channel moved by 8/255. Pixels of other classes: untouched = no "
    "channel moved by 8/255. Surface points whose density (sum of o exp(-d^2 / 2)) was at least 0.05: of the class, gone = "
    "less than half is left; of others, kept = at least half is left"
)
RECOLOR = (
    "kfgs-recolor/1: test views of a scene with exact labels. Outside = PSNR of after against before over all pixels of "
    "other classes and channels; inside = share of the class's coloured pixels whose hue is within 20 degrees of the target"
)
UNCOVERED = (
    "kfgs-uncovered/1: the pixels of test views that show the class, after its removal, against the same views of the scene "
    "without it: one PSNR over all these pixels and channels, and the mean of SSIM (kornia, Gaussian window 11x11 with sigma "
    "1.5) at them. Untouched = share of the pixels of other classes of which the edit moved no channel by 8/255"
)
MOVED = (
    "kfgs-moved/1: the same for a class that was moved: the pixels that show it before or after, against the scene with the "
    "class there"
)
STEP = 8 / 255  # a channel that moves less is untouched: twice what 8-bit rounding and a JPEG would do
HUE = 20.0  # degrees
LEAST_LIGHT = 0.25  # share of a pixel's light that the object gave before the edit; of other pixels nothing can be said
LEAST_DENSITY = 0.05  # at a surface point before the edit, for the same reason
LEAST_CHROMA = 0.04  # ten 8-bit steps between the largest and the smallest channel: below, a hue is noise
BORDER = 2  # pixels around the class whose light is mixed: pictures are sampled, Gaussians have soft edges


@dataclass(frozen=True)
class RemovalReport:
    """Shares in [0, 1] (NaN if nothing could be measured), and how much was measured."""

    name: str
    """The class that was to be removed."""
    gone_pixels: float
    """The class's pixels that no longer show it."""
    changed_pixels: float
    """The class's pixels that look different, by at least 8/255 in some channel."""
    untouched_pixels: float
    """The pixels of other classes that did not change."""
    untouched_off_border: float
    """The same without the pixels within 2 of the class, where soft edges mix the two."""
    gone_points: float
    """The class's surface where its density is gone."""
    kept_points: float
    """The other surfaces where the density stayed."""
    measured_pixels: float
    """The class's pixels that the object's Gaussians showed before the edit."""
    measured_points: float
    """The class's surface points that the cloud covered before the edit."""
    views: int
    protocol: str = REMOVAL

    @property
    def passed(self) -> bool:
        """Whether 0.95 of the class is gone and 0.98 of the rest untouched, in pictures and on surfaces.

        Also, 0.8 of the class's pixels must have changed (a class that looks as before is not gone, but some things match
        their background), and half of its pixels and of its surface must have been measured.
        """
        gone = (
            self.gone_pixels >= 0.95 and self.gone_points >= 0.95 and self.changed_pixels >= 0.8
        )  # NaN passes nothing
        kept = self.untouched_pixels >= 0.98 and self.kept_points >= 0.98
        return gone and kept and self.measured_pixels >= 0.5 and self.measured_points >= 0.5

    def __str__(self) -> str:
        return (
            f"{self.name} removed: {self.gone_pixels:.4f} of its pixels gone ({self.changed_pixels:.4f} changed), "
            f"{self.gone_points:.4f} of its surface; "
            f"untouched elsewhere: {self.untouched_pixels:.4f} of the pixels ({self.untouched_off_border:.4f} off its "
            f"border), {self.kept_points:.4f} of the surface ({self.protocol.split(':')[0]}, {self.views} views)"
        )

    def to_json(self) -> dict[str, Any]:
        """The report as plain values; NaN becomes null."""
        return _plain(self)


@dataclass(frozen=True)
class RecolorReport:
    """How far a recolouring stayed inside its object, and whether it got its colour."""

    name: str
    """The class that was to be recoloured."""
    rgb: tuple[float, float, float]
    """The colour that was asked for, in [0, 1]."""
    psnr_outside: float
    """Decibels over all pixels of other classes; infinite if nothing changed there."""
    psnr_off_border: float
    """The same without the pixels within 2 of the class, where soft edges mix the two."""
    hue_inside: float
    """The class's coloured pixels that have the target's hue."""
    hue_before: float
    """The same before the edit: a brown chair is hardly moved by red."""
    measured_pixels: float
    """The class's pixels with enough colour after the edit to have a hue."""
    views: int
    protocol: str = RECOLOR

    @property
    def passed(self) -> bool:
        """Whether no other object changed (at least 35 dB outside) and at least 0.8 of the class has the new hue."""
        return self.psnr_outside >= 35 and self.hue_inside >= 0.8 and self.measured_pixels >= 0.5

    def __str__(self) -> str:
        return (
            f"{self.name} recoloured: PSNR outside {self.psnr_outside:.1f} dB ({self.psnr_off_border:.1f} off its "
            f"border), {self.hue_inside:.4f} of its coloured pixels have the hue ({self.hue_before:.4f} before) "
            f"({self.protocol.split(':')[0]}, {self.views} views)"
        )

    def to_json(self) -> dict[str, Any]:
        """The report as plain values; what could not be measured, and an infinite PSNR, is null."""
        return _plain(self)


def score_removal(
    before: Gaussians, after: Gaussians, scene: str | Path, name: str, *, split: str = "test"
) -> RemovalReport:
    """Score the removal of a class (protocol `kfgs-removal/1`, see `REMOVAL`).

    A Gaussian shows the object if its centre is nearer to the class's true surface than to any other. Depth cannot
    tell: a rug lies on its floor, and a picture hangs flat on its wall. So Gaussians that only moved to where another
    surface is nearest count as gone; how few of the class's pixels changed gives that away, unless it has a texture.

    Args:
        before: the colour field, with `sh`.
        after: the same field without the class.
        scene: a folder with exact labels and surfaces, as `make_toy_room` writes it, in whose frame both fields are.
        name: the class.
        split: which views are looked at.

    Raises:
        FileNotFoundError: if the scene lacks labels or `surface.npz`.
        ValueError: if the scene has no such class, no view of the split shows it, or a field has no `sh`.
    """
    truth = ClassTruth(as_path(scene), name, split)
    surface = find_points(truth.folder)
    points, of_class = surface.points, torch.isin(surface.labels, truth.labels)
    owned = [_is_nearest(cloud, points, of_class) for cloud in (before, after)]
    gone, changed, shown, untouched, off_border = (_Share() for _ in range(5))
    for camera, inside, far in truth.views():
        old, new = (_picture(cloud, camera) for cloud in (before, after))
        light, left = (_light(cloud, mine, camera) for cloud, mine in zip((before, after), owned, strict=True))
        same, seen = (new - old).abs().amax(-1) < STEP, light >= LEAST_LIGHT
        shown.add(seen, among=inside)
        gone.add(left < 0.5 * light, among=inside & seen)
        changed.add(~same, among=inside & seen)
        untouched.add(same, among=~inside)
        off_border.add(same, among=far)
    density, rest = (surface_density(cloud, points) for cloud in (before, after))
    covered, lost = density >= LEAST_DENSITY, rest < 0.5 * density
    return RemovalReport(
        name=name,
        gone_pixels=gone.value,
        changed_pixels=changed.value,
        untouched_pixels=untouched.value,
        untouched_off_border=off_border.value,
        gone_points=_Share().add(lost, among=covered & of_class).value,
        kept_points=_Share().add(~lost, among=covered & ~of_class).value,
        measured_pixels=shown.value,
        measured_points=_Share().add(covered, among=of_class).value,
        views=len(truth.indices),
    )


def score_recolor(
    before: Gaussians, after: Gaussians, scene: str | Path, name: str, rgb: Sequence[float], *, split: str = "test"
) -> RecolorReport:
    """Score the recolouring of a class (protocol `kfgs-recolor/1`, see `RECOLOR`).

    Args:
        before: the colour field, with `sh`.
        after: the same field, recoloured.
        scene: a folder with labels of every view, as `make_toy_room` writes it, in whose frame both fields are.
        name: the class.
        rgb: the colour that was asked for, three numbers in [0, 1] that are not all alike: grey has no hue.
        split: which views are looked at.

    Raises:
        FileNotFoundError: if the scene lacks labels.
        ValueError: if the scene has no such class, no view of the split shows it, `rgb` is not a colour with a hue, or a
            field has no `sh`.
    """
    wanted = torch.as_tensor(rgb, dtype=torch.float32)
    if wanted.shape != (3,) or not bool(((wanted >= 0) & (wanted <= 1)).all()):
        raise ValueError(f"rgb: expected three numbers in [0, 1], got {rgb!r}; divide 8-bit colours by 255")
    if float(wanted.max() - wanted.min()) < LEAST_CHROMA:
        raise ValueError(f"rgb: expected a colour with a hue, got the grey {rgb!r}; score another colour")
    truth = ClassTruth(as_path(scene), name, split)
    colored, right, right_before = _Share(), _Share(), _Share()
    outside, off_border = [], []  # sum of squares and number of values, for each view
    for camera, inside, far in truth.views():
        old, new = (_picture(cloud, camera) for cloud in (before, after))
        squares = (new - old).double().square()
        outside.append((float(squares[~inside].sum()), 3 * int((~inside).sum())))
        off_border.append((float(squares[far].sum()), 3 * int(far.sum())))
        for picture, share in ((old, right_before), (new, right)):
            has_hue = picture.amax(-1) - picture.amin(-1) >= LEAST_CHROMA
            turn = (_hue_degrees(picture) - _hue_degrees(wanted[None, None])).remainder(360)
            share.add(torch.minimum(turn, 360 - turn) <= HUE, among=inside & has_hue)
        colored.add(has_hue, among=inside)
    return RecolorReport(
        name=name,
        rgb=(float(rgb[0]), float(rgb[1]), float(rgb[2])),
        psnr_outside=_psnr(outside),
        psnr_off_border=_psnr(off_border),
        hue_inside=right.value,
        hue_before=right_before.value,
        measured_pixels=colored.value,
        views=len(truth.indices),
    )


@dataclass(frozen=True)
class UncoveredReport:
    """How the places look that a removed class covered; NaN where nothing was measured."""

    name: str
    """The class that was removed, or moved."""
    psnr: float
    """Decibels."""
    ssim: float
    untouched_pixels: float
    """The pixels of other classes that did not change, in [0, 1]."""
    pixels: int
    """How many pixels the class covered."""
    views: int
    protocol: str = UNCOVERED

    def __str__(self) -> str:
        return (
            f"{self.name}: {self.psnr:.2f} dB, SSIM {self.ssim:.3f} over its pixels ({self.pixels:,} pixels of "
            f"{self.views} views); untouched elsewhere: {self.untouched_pixels:.4f} ({self.protocol.split(':')[0]})"
        )


def score_uncovered(
    before: Gaussians, after: Gaussians, scene: str | Path, name: str, *, split: str = "test", moved: bool = False
) -> UncoveredReport:
    """Score what the removal of a class uncovers, or its move (protocols `kfgs-uncovered/1`, `kfgs-moved/1`).

    Args:
        before: the colour field.
        after: the same field without the class, or with the class moved.
        scene: a folder that `make_toy_room` wrote (the room is rendered again, without the class), or `benchmarks/rooms.py`
            whose `without/` lacks what is named, and whose `moved/` has it elsewhere.
        name: the class, or several between commas.
        split: which views are looked at.
        moved: whether it was moved, as `moved` of the room's JSON says.

    Raises:
        FileNotFoundError: if the scene has neither `toy.json` nor `without/`.
        ValueError: as `score_removal`.
    """
    truth = ClassTruth(as_path(scene), name, split)
    squares, similar, count, untouched = 0.0, 0.0, 0, _Share()
    for i, (camera, inside, _) in zip(truth.indices, truth.views(), strict=True):
        old, new = (_picture(cloud, camera) for cloud in (before, after))
        if moved:
            labels = load_label_map(truth.folder / "moved/labels" / f"{truth.scene.stem(i)}.png")
            inside = inside | torch.isin(labels, truth.labels)
        wanted = _edited(truth.folder, truth.scene.stem(i), camera, name, moved)
        pair = (picture.permute(2, 0, 1)[None] for picture in (new, wanted))
        squares += float((new - wanted).double().square()[inside].sum())
        similar += float(kornia.metrics.ssim(*pair, 11)[0].mean(dim=0)[inside].double().sum())
        count += int(inside.sum())
        untouched.add((new - old).abs().amax(-1) < STEP, among=~inside)
    ssim = similar / count if count else math.nan
    score = _psnr([(squares, 3 * count)]), ssim, untouched.value, count, len(truth.indices)
    return UncoveredReport(name, *score, MOVED if moved else UNCOVERED)


def _edited(folder: Path, stem: str, camera: Camera, name: str, moved: bool) -> Tensor:  # [H, W, 3] in [0, 1]
    """The true picture of a view without a class, or with the class moved."""
    if (folder / "toy.json").is_file() and not moved:
        seed = read_json(folder / "toy.json")["config"]["seed"]
        solids = [solid for solid in build_room(seed) if solid.label not in name.split(",")]
        picture = render(solids, Noise(np.random.default_rng([seed, 3])), camera)[0]
    else:
        picture = np.array(Image.open(folder / ("moved" if moved else "without") / "images" / f"{stem}.png"))
    return torch.from_numpy(picture).float() / 255


class ClassTruth:
    """The pixels that show a class, or one of several ("table,bottle"), in the views of a split."""

    def __init__(self, folder: Path, name: str, split: str) -> None:
        names, parts = read_json(folder / "classes.json"), name.split(",")
        if not set(parts) <= set(names):
            raise ValueError(f"name: expected one of {', '.join(names)} (classes of {folder}), got {name!r}")
        self.folder, self.labels = folder, torch.tensor([names.index(part) for part in parts])
        self.scene: Scene = load_scene(folder)
        self.indices = tuple(self.scene.views(split))
        if not any(bool(self._inside(i).any()) for i in self.indices):
            raise ValueError(
                f"name: expected a class that is seen in some of the {len(self.indices)} views of {split!r}, got {name!r}, "
                "which none shows; choose another class or split"
            )

    def _inside(self, i: int) -> Tensor:  # [H, W] bool
        return torch.isin(self._labels(i), self.labels)

    def _labels(self, i: int) -> Tensor:  # [H, W] int64
        path, camera = self.folder / "labels" / f"{self.scene.stem(i)}.png", self.scene.cameras[i]
        labels = load_label_map(path)
        if tuple(labels.shape) != camera.size:
            raise ValueError(f"{path}: expected {camera.size} values (rows, columns), got {tuple(labels.shape)}")
        return labels

    def views(self) -> Iterator[tuple[Camera, Tensor, Tensor]]:  # [H, W] bool, [H, W] bool
        """Each camera, the pixels of the class, and those at least BORDER pixels away; without masked or transparent ones."""
        for i in self.indices:
            inside, camera = self._inside(i), self.scene.cameras[i]
            grown = torch.nn.functional.max_pool2d(inside[None].float(), 2 * BORDER + 1, 1, BORDER)[0] > 0
            counted = self.scene.counted(i, camera.size)
            counted = torch.ones_like(inside) if counted is None else counted
            yield camera, inside & counted, ~grown & counted


class _Share:
    """A share that is counted over the views."""

    def __init__(self) -> None:
        self.hits, self.count = 0, 0

    def add(self, which: Tensor, *, among: Tensor) -> _Share:
        self.hits += int((which & among).sum())
        self.count += int(among.sum())
        return self

    @property
    def value(self) -> float:
        return self.hits / self.count if self.count else math.nan


def _psnr(sums: Sequence[tuple[float, int]]) -> float:
    """One PSNR over all views."""
    total, count = (sum(column) for column in zip(*sums, strict=True))
    if count == 0:
        return math.nan
    return -10 * math.log10(total / count) if total > 0 else math.inf


def _picture(cloud: Gaussians, camera: Camera) -> Tensor:  # [H, W, 3] in [0, 1]
    if cloud.sh is None:
        raise ValueError("before, after: expected colour fields with sh [N, K, 3], got None; pass the colour field")
    return rasterize(cloud.detach().replace(features=None), camera).map.clamp(0, 1).cpu()


def _light(cloud: Gaussians, owned: Tensor, camera: Camera) -> Tensor:  # [H, W] in [0, 1]
    """How much of each pixel's light comes from some of the Gaussians."""
    shares = owned.to(cloud.means)[:, None]
    return rasterize(cloud.detach().replace(features=shares, sh=None), camera).map[..., 0].cpu()


def _is_nearest(cloud: Gaussians, points: Tensor, of_class: Tensor) -> Tensor:  # [P, 3], [P] bool -> [N] bool
    """Which Gaussians are nearer to the class's surface than to any other."""
    nearest = cKDTree(recounted(points, ORIGIN, cloud.origin).numpy()).query(cloud.means.detach().cpu().numpy())[1]
    return of_class[torch.from_numpy(nearest)]


def _hue_degrees(rgb: Tensor) -> Tensor:  # [H, W, 3] -> [H, W]
    return kornia.color.rgb_to_hsv(rgb.permute(2, 0, 1)[None])[0, 0].rad2deg()


def _plain(report: RemovalReport | RecolorReport) -> dict[str, Any]:
    values = asdict(report) | {"passed": report.passed}
    return {key: None if isinstance(v, float) and not math.isfinite(v) else v for key, v in values.items()}
