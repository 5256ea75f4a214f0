"""The protocols of kfgs by name. Each is a frozen dataclass: its fields are options, with the published values as defaults.

`open` reads what is asked of every method: the truth, and the views that are scored. `score` asks one method. Whatever has
these two members, `name` and `about` is a protocol; `benchmarks/published` has more.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import torch

from .._check import ORIGIN, check_whole
from .._origin import recounted
from ..gaussians import Gaussians
from ..scenes import Scene
from ..scenes.load import SplitChoice
from .color import COLOR_PROTOCOL, score_views
from .find import find_points
from .method import LabelRule, Method, View, annotated, best_labels, check_level, label_view
from .report import Report, Row, make_report, mean
from .segmentation import PROTOCOL, evaluate_segmentation
from .surface import ABOUT, NAME, score_surface
from .teacher_agreement import TeacherAgreement
from .texts import Encode, encode_unit
from .truth import LabelTruth, Merged, PointTruth, is_void, merge_table, name_key
from .views import label_views


@dataclass(frozen=True)
class KfgsPooled:
    """Closed-set segmentation of views: `evaluate_segmentation` as a protocol."""

    name: ClassVar[str] = "kfgs-pooled/1"
    about: ClassVar[str] = PROTOCOL.partition(": ")[2]
    rule: ClassVar[LabelRule] = "own"
    """How a field of kfgs decides the class of a pixel (`FieldMethod`)."""
    open = staticmethod(label_views)

    level: int = 0
    """The map of a method with several."""
    merged: Merged = ()
    """Pairs of names: the first class counts as the second, in truth and answer."""
    most: int | None = None
    """Average the IoU of this many classes, those with most true pixels (ties by name); None: of all that occur."""

    def __post_init__(self) -> None:
        check_whole("most", 1 if self.most is None else self.most, 1)

    def score(self, method: Method, truth: LabelTruth, views: Sequence[View], encode: Encode) -> Report:
        """Segment each view that has a label picture."""
        text, cameras = encode_unit(encode, truth.names), {view.stem: view for view in annotated(views, truth.maps)}
        answer, keys = partial(label_view, method, text=text, level=self.level), set(map(name_key, truth.names))
        merged = tuple(  # a scene need not have the classes of the published pairs
            pair for pair in self.merged if pair not in type(self).merged or keys.issuperset(map(name_key, pair))
        )
        scored = evaluate_segmentation(lambda stem: answer(cameras[stem]).cpu(), truth.maps, truth.names, merged=merged)
        pixels = (scored.confusion.sum(dim=1) + scored.misses).tolist()
        chosen = [i for i, iou in enumerate(scored.iou.tolist()) if iou == iou]
        if self.most is not None:
            chosen = sorted((i for i in chosen if pixels[i]), key=lambda i: (-pixels[i], truth.names[i]))[: self.most]
        rows: list[Row] = [{"class": truth.names[i], "IoU": float(scored.iou[i])} for i in chosen]
        scores = {"mIoU": mean(float(scored.iou[i]) for i in chosen), "accuracy": scored.accuracy.value}
        notes = [] if self.most is None else [f"classes: {', '.join(truth.names[i] for i in chosen)}"]
        return make_report(self, method.name, scores, rows, notes)


@dataclass(frozen=True)
class DF3DGS(KfgsPooled):
    """The paper's score (Sec. 4.1): "rugs" are floor, "class = 10". It lists neither merges nor classes: these are ours."""

    name: ClassVar[str] = "df3dgs/1"
    about: ClassVar[str] = (
        "one confusion matrix over the test views of the paper's split after merging (rug to floor), mean IoU of the ten classes "
        "with most true pixels (ties by name); all classes are asked; accuracy over all pixels"
    )
    rule: ClassVar[LabelRule] = "paper"
    scene_split: ClassVar[SplitChoice] = "df3dgs"
    """The split whose test views are scored, whatever lists the scene has (`pipeline.open_question`)."""

    merged: Merged = (("rugs", "floor"), ("rug", "floor"))
    most: int | None = 10


@dataclass(frozen=True)
class KfgsSurface:
    """Classes of surface points, carried over from the nearest labelled Gaussian: `score_surface` as a protocol.

    A name that means "no class" (`VOID_NAMES`) is not asked, and its points are not scored; a note counts them.
    """

    name: ClassVar[str] = NAME
    about: ClassVar[str] = ABOUT

    level: int = 0
    """The map of a method with several."""
    merged: Merged = ()
    """As in `KfgsPooled`."""

    @staticmethod
    def open(
        scene: Scene, folder: Path, truth: Path | None = None, split: str | None = None
    ) -> tuple[PointTruth, list[View]]:
        """The labelled points of the scene (`find_points`); no views."""
        return find_points(truth or folder), []

    def score(self, method: Method, truth: PointTruth, views: Sequence[View], encode: Encode) -> Report:
        """Label the Gaussians with the truth's names, and carry the labels to its points; `views` are not used."""
        if method.gaussians is None:
            raise TypeError(f"method: expected one with Gaussians, got {method.name!r}; use a protocol of views")
        check_level(method, self.level)
        names = tuple(dict.fromkeys(name for name in truth.names.values() if not is_void(name)))
        if not names:
            raise ValueError(f"truth: expected names of classes, got {', '.join(truth.names.values()) or 'none'}")
        cosines = method.gaussian_cosines(encode_unit(encode, names))[self.level]
        points = recounted(truth.points, ORIGIN, method.gaussians.origin).to(method.gaussians.means)
        target, left_out = torch.full_like(truth.labels, -1), list[str]()
        for label, name in truth.names.items():
            same = truth.labels == label
            if not is_void(name):
                target[same] = names.index(name)
            elif bool(same.any()):
                left_out.append(f"{name} ({int(same.sum())} points)")
        table = merge_table(names, self.merged).to(target.device)
        scored = score_surface(method.gaussians.means, table[best_labels(cosines)], points, table[target])
        notes = [f"not scored, no class: {', '.join(left_out)}"] if left_out else []
        return make_report(self, method.name, scored.scores, scored.rows, notes)


@dataclass(frozen=True)
class KfgsColor:
    """Pictures of views that a colour field has not learnt: `score_views` as a protocol."""

    name: ClassVar[str] = "kfgs-color/1"
    about: ClassVar[str] = COLOR_PROTOCOL.partition(": ")[2]
    of_colors: ClassVar[bool] = True
    """Scores Gaussians with colours, not a method with features."""

    @staticmethod
    def open(
        scene: Scene, folder: Path, truth: Path | None = None, split: str | None = None
    ) -> tuple[Scene, list[View]]:
        """The scene with the views of the split (None: the test views); a ValueError if another truth is named."""
        if truth is not None:
            raise ValueError(f"truth: expected none with kfgs-color/1 (the photos are), got {truth}; leave it out")
        chosen = scene.select(scene.views(split or "test"))
        return chosen, [View(chosen.stem(i), camera) for i, camera in enumerate(chosen.cameras)]

    def score(
        self, method: Gaussians, truth: Scene, views: Sequence[View] = (), encode: Encode | None = None
    ) -> Report:
        """Render all views of the scene `truth`, and compare them with its photos."""
        scored = score_views(method, truth, "all")
        rows: list[Row] = [{"view": view.name, "PSNR": view.psnr, "SSIM": view.ssim} for view in scored.views]
        return make_report(self, "", {"PSNR": scored.psnr.value, "SSIM": scored.ssim.value}, rows)


PROTOCOLS: dict[str, Any] = {kind.name: kind for kind in (KfgsPooled, DF3DGS, KfgsSurface, KfgsColor, TeacherAgreement)}
"""The protocols by name; see docs/protocols.md."""


def get_protocol(name: str, protocols: dict[str, Any] = PROTOCOLS, **options: Any) -> Any:
    """A protocol by its name, with or without its version: "kfgs-pooled/1", "kfgs-pooled".

    Args:
        name: one of `protocols`.
        protocols: where to look.
        **options: fields of the protocol; the others are as published.

    Raises:
        ValueError: if there is no such protocol or version; the message names the nearest ones.
        TypeError: if the protocol has no such option.

    Example:
        >>> get_protocol("feature3dgs-teacher", split=None).split is None
        True
    """
    kind = next((kind for key, kind in protocols.items() if name in (key, key.partition("/")[0])), None)
    if kind is None:
        near = difflib.get_close_matches(name, protocols, n=3, cutoff=0.4)
        hint = f"; did you mean {' or '.join(near)}?" if near else ""
        raise ValueError(f"protocol: expected one of {', '.join(protocols)}, got {name!r}{hint}")
    return kind(**options)
