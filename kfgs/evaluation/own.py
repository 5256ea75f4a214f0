"""kfgs's own protocols as named objects, beside the published ones: pooled, surface, colour, removal and recolouring."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from torch import Tensor

from .._check import ORIGIN
from .._origin import recounted
from ..gaussians import Gaussians
from ..scenes import Scene
from .class_lists import VOID_NAMES, name_key
from .color import COLOR_PROTOCOL, score_views
from .edit_reports import RECOLOR, REMOVAL, RecolorReport, RemovalReport
from .editing import score_recolor, score_removal
from .method import Method, View, annotated, best_labels, check_level, label_view
from .relevancy import Encode, encode_unit
from .report import Report, Row, make_report
from .scannet_points import needed
from .scenesplat import match_names
from .segmentation import PROTOCOL, evaluate_segmentation
from .surface import SURFACE_PROTOCOL, score_surface
from .truth import LabelTruth, PointTruth


@dataclass(frozen=True)
class KfgsPooled:
    """Closed-set segmentation of views: `evaluate_segmentation` as a protocol."""

    name: ClassVar[str] = "kfgs-pooled/1"
    about: ClassVar[str] = PROTOCOL.partition(": ")[2]

    level: int = 0
    """Of a method with several maps and no rule of its own."""

    def score(self, method: Method, truth: LabelTruth, views: Sequence[View], encode: Encode) -> Report:
        """Segment each view that has a label picture.

        Raises:
            ValueError: if a label picture has no view, or the truth holds nothing that can be scored.
        """
        text = encode_unit(encode, truth.names)
        cameras = {view.stem: view for view in annotated(views, truth.maps)}

        def predict(stem: str) -> Tensor:
            return label_view(method, cameras[stem], text, self.level).cpu()

        found = evaluate_segmentation(predict, truth.maps, truth.names)
        rows: list[Row] = [
            {"class": name, "IoU": iou} for name, iou in zip(found.names, found.iou.tolist(), strict=True) if iou == iou
        ]
        scores = {"mIoU": found.miou.value, "accuracy": found.accuracy.value}
        return make_report(self, method.name, scores, rows)


@dataclass(frozen=True)
class KfgsSurface:
    """Classes of surface points, carried over from the nearest labelled Gaussian: `score_surface` as a protocol."""

    name: ClassVar[str] = "kfgs-surface/1"
    about: ClassVar[str] = SURFACE_PROTOCOL.partition(": ")[2]

    level: int = 0
    """Of a method with several."""

    def score(
        self, method: Method, truth: PointTruth, views: Sequence[View] = (), encode: Encode | None = None
    ) -> Report:
        """Label the Gaussians with the truth's names, and carry the labels to its points; `views` are not used.

        A name that means "no class" (`VOID_NAMES`) is not asked, and its points are not scored; a note counts them.

        Raises:
            TypeError: if the method has no Gaussians.
            ValueError: if no point has a class, or the truth names none.
        """
        if method.gaussians is None:
            raise TypeError(
                f"method: expected one with Gaussians, got {method.name!r} without; use a protocol of views"
            )
        check_level(method, self.level)
        void = {name_key(name) for name in VOID_NAMES}
        names = tuple(dict.fromkeys(name for name in truth.names.values() if name_key(name) not in void))
        if not names:
            got = ", ".join(truth.names.values()) or "none"
            raise ValueError(f"truth: expected names of classes, got {got}; give the names of the points' labels")
        cosines = method.gaussian_cosines(encode_unit(needed(encode), names))[self.level]
        points = recounted(truth.points, ORIGIN, method.gaussians.origin).to(method.gaussians.means)
        target = match_names(truth, names)
        found = score_surface(method.gaussians.means, best_labels(cosines), points, target.labels)
        rows: list[Row] = [
            {"lambda": found.transfer.distance, "labelled": found.transfer.labelled, "points": found.points}
        ]
        left_out = ", ".join(f"{name} ({count} points)" for name, count in target.left_out.items())
        notes = [f"not scored, no class: {left_out}"] if left_out else []
        return make_report(self, method.name, {"agreement": found.agreement}, rows, notes)


@dataclass(frozen=True)
class KfgsColor:
    """Pictures of views that a colour field has not learnt: `score_views` as a protocol."""

    name: ClassVar[str] = "kfgs-color/1"
    about: ClassVar[str] = COLOR_PROTOCOL.partition(": ")[2]

    split: str = "test"
    """Which views of the scene."""

    def score(self, gaussians: Gaussians, scene: Scene) -> Report:
        """Render the views of the split; see `score_views`."""
        found = score_views(gaussians, scene, self.split)
        rows: list[Row] = [{"view": view.name, "PSNR": view.psnr, "SSIM": view.ssim} for view in found.views]
        return make_report(self, "", {"PSNR": found.psnr.value, "SSIM": found.ssim.value}, rows)


@dataclass(frozen=True)
class KfgsRemoval:
    """Is a removed class gone, and nothing else: `score_removal` as a protocol.

    The headline is the lowest of its four shares, so that a scene where everything was deleted does not come first.
    """

    name: ClassVar[str] = "kfgs-removal/1"
    about: ClassVar[str] = REMOVAL.partition(": ")[2]

    split: str = "test"
    """Which views of the scene."""

    def score(self, before: Gaussians, after: Gaussians, scene: str | Path, removed: str) -> Report:
        """Compare a colour field with the same field without the class `removed`; see `score_removal`."""
        found = score_removal(before, after, scene, removed, split=self.split)
        shares = _named(found, ("gone_pixels", "untouched_pixels", "gone_points", "kept_points"))
        return _of_edit(self, found, {"lowest share": float(np.min(list(shares.values())))} | shares)  # NaN if one is


@dataclass(frozen=True)
class KfgsRecolor:
    """Does a recoloured class have its colour, and nothing else: `score_recolor` as a protocol."""

    name: ClassVar[str] = "kfgs-recolor/1"
    about: ClassVar[str] = RECOLOR.partition(": ")[2]

    split: str = "test"
    """Which views of the scene."""

    def score(
        self, before: Gaussians, after: Gaussians, scene: str | Path, painted: str, rgb: Sequence[float]
    ) -> Report:
        """Compare a colour field with the same field where the class `painted` has the colour `rgb`; see `score_recolor`."""
        found = score_recolor(before, after, scene, painted, rgb, split=self.split)
        return _of_edit(self, found, _named(found, ("psnr_outside", "hue_inside")))


def _named(found: RemovalReport | RecolorReport, names: Sequence[str]) -> dict[str, float]:
    return {name.replace("_", " "): getattr(found, name) for name in names}


def _of_edit(protocol: object, found: RemovalReport | RecolorReport, scores: dict[str, float]) -> Report:
    values: dict[str, Any] = found.to_json()
    row: Row = {"class": found.name, **{key: values[key] for key in values if key not in ("name", "protocol")}}
    return make_report(protocol, "", scores, [row])
