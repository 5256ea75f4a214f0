"""What methods are asked: a protocol, a scene, its ground truth and the views; the same for every method that is compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from .._card import short_repr
from .._check import check_choice
from .._files import as_path
from ..evaluation import (
    Encode,
    FieldMethod,
    Labeller,
    LabelTruth,
    MaskTruth,
    PointTruth,
    Report,
    TeacherMethod,
    View,
    get_protocol,
)
from ..evaluation.datasets import find_labels, find_masks, find_points, truth_views
from ..evaluation.datasets.files import ReadWhenAsked
from ..evaluation.datasets.views import named_as_in
from ..evaluation.digests import digest_data
from ..evaluation.encoders import NotedEncoder
from ..evaluation.segmentation import load_label_map
from ..formats import read_splats
from ..gaussians import Gaussians
from ..labels.color import parse_color
from ..scenes import FeatureFolder, Scene, load_scene
from .maps import changing_files, labels_of_view, maps_of_views

EDIT_INPUTS = {"kfgs-removal/1": ("before", "removed"), "kfgs-recolor/1": ("before", "painted", "rgb")}
"""What the protocols of edits need besides the edited splat."""
IN_SPACE = ("kfgs-surface/1", "lerf-ovs-3d/1", "scannet-points/1", "scannet-volume/1", "scenesplat-fmiou/1")
"""Protocols that ask Gaussians, not pictures."""
OF_COLORS = ("kfgs-color/1", *EDIT_INPUTS)
"""Protocols that score Gaussians with colours instead of a method."""

LABELLED = ("kfgs-pooled/1", "feature3dgs-teacher/1", "3dovs-closed/1")
"""Protocols that take one class per pixel, so that a method's own rule for it counts."""

Labels = Literal["own", "nearest"]
Truth = LabelTruth | MaskTruth | PointTruth | TeacherMethod


@dataclass(frozen=True, eq=False)
class Question:
    """What each method is asked; `score` asks one."""

    protocol: Any
    folder: Path
    """The scene's."""
    scene: Scene
    """Without distortion."""
    truth: Truth | None
    """None: of colours and edits, whose truth is in the scene folder."""
    views: tuple[View, ...]
    """Those that are scored; of the teacher's protocol, those that it chooses from."""
    digests: Mapping[str, str]
    """Of views and truth."""
    inputs: Mapping[str, Any]
    """Of the protocols of edits: before, and the class."""
    labels: Labels | None = None
    """The rule for classes of pixels that was asked for; `rule` is the one that counts."""

    __repr__ = short_repr

    @property
    def rule(self) -> Labels:
        """Who says the class of a pixel: the field (`SemanticField.segment`), or the text with the largest cosine.

        If none was asked for: the field in kfgs's own protocols, the nearest text in those that others published, which
        define the class so.
        """
        return self.labels or ("own" if self.protocol.name.startswith("kfgs-") else "nearest")

    @property
    def scored(self) -> tuple[View, ...]:
        """The views whose pictures are scored; none of a protocol of points."""
        if self.protocol.name in OF_COLORS:
            return tuple(_views(self.scene, self.protocol.split))
        return tuple(getattr(self.protocol, "chosen", list)(list(self.views)))

    def score(self, method: Any, encode: Encode | None = None) -> Report:
        """Ask a method; of colours and edits, Gaussians.

        Raises:
            TypeError: if the method has no Gaussians and the protocol needs some.
            ValueError: if the protocol cannot score it, or a text has no embedding.
        """
        given = dict(self.inputs)
        if self.protocol.name in EDIT_INPUTS:
            before = read_splats(given.pop("before")).gaussians
            return self.protocol.score(before, method, self.folder, *given.values()).of(digests=self.digests)
        if self.protocol.name in OF_COLORS:
            return self.protocol.score(method, self.scene).of(digests=self.digests)
        if encode is None:
            raise ValueError("text: expected text embeddings, got none; pass a label set or a teacher's text encoder")
        noted = NotedEncoder(encode)
        method = self._with_rule(method)
        found: Report = self.protocol.score(method, self.truth, list(self.views), noted)
        if self.protocol.name in LABELLED:
            found = self._name_rule(found, method)
        return found.of(digests={**self.digests, "texts": digest_data(noted.rows)})

    def _with_rule(self, method: Any) -> Any:
        if self.labels is None or not isinstance(method, FieldMethod):
            return method
        return FieldMethod(method.field, method.name, own_labels=self.labels == "own")

    def _name_rule(self, report: Report, method: Any) -> Report:
        """The report with the option `labels`. A method without a rule of its own can be compared under either."""
        rule = self.rule
        if isinstance(method, Labeller):
            rule = "own" if getattr(method, "own_labels", True) else "nearest"
        changed = ("labels",) if rule != replace(self, labels=None).rule else ()
        return replace(report, options={**report.options, "labels": rule}, changed=(*report.changed, *changed))


def open_question(
    scene: str | Path,
    protocol: str = "kfgs-pooled/1",
    *,
    truth: str | Path | None = None,
    split: str | None = None,
    images: str | Path | None = None,
    options: Mapping[str, Any] | None = None,
    labels: Labels | None = None,
) -> Question:
    """Read a scene and its ground truth for a protocol.

    Args:
        scene: its folder.
        protocol: a name of `kfgs.evaluation.PROTOCOLS`.
        truth: where the ground truth is, if not in the scene's folder (`find_labels`, `find_masks`, `find_points`). For
            `feature3dgs-teacher/1` it is the folder of the teacher's maps; None: `features/` in the scene.
        split: which views. None depends on the truth. Label pictures: the test views, or all views if no test view has one.
            Masks: all pictures that have some. A teacher's maps: all views.
        images: folder of the pictures.
        options: of the protocol; those left out are as published. An edit's protocol also needs its inputs here: `before` (a
            splat file), `removed` or `painted` (a class), `rgb`.
        labels: how a field of kfgs decides the class of a pixel: `own` is `SemanticField.segment`; `nearest` is the text with
            the largest cosine, as for other methods. None: the protocol's choice (`Question.rule`).

    Raises:
        FileNotFoundError: if the scene or its truth is missing.
        ValueError: if protocol, options, split, truth or labels do not fit.
    """
    given, folder = dict(options or {}), as_path(scene)
    name = get_protocol(protocol).name
    inputs = _edit_inputs(name, given)
    if labels is not None:
        check_choice("labels", labels, get_args(Labels))
        if name not in LABELLED:
            raise ValueError(
                f"labels: expected none with {name}, which takes no class per pixel, got {labels!r}; leave it out"
            )
    if split is not None and name in OF_COLORS:
        given["split"] = split
    chosen = get_protocol(name, **given)
    loaded = load_scene(folder, images=images).undistorted()
    if name in OF_COLORS:
        if truth is not None:
            raise ValueError(
                f"truth: expected none with {name}, whose truth is in the scene, got {truth}; leave it out"
            )
        digests = {
            "views": _digest_views(_views(loaded, chosen.split)),
            "truth": _digest_scene(loaded, folder, chosen, inputs),
        }
        return Question(chosen, folder, loaded, None, (), digests, inputs)
    kind = type(chosen).score.__annotations__["truth"]
    if kind == "PointTruth":
        points = find_points(truth or folder, getattr(chosen, "benchmark", None))
        return Question(chosen, folder, loaded, points, (), {"truth": digest_data(points)}, inputs)
    if kind == "Method":
        return replace(_ask_teacher(chosen, folder, loaded, truth, split), labels=labels)
    found: LabelTruth | MaskTruth = (find_labels if kind == "LabelTruth" else find_masks)(truth or folder)
    found = _as_viewed(_of_split(named_as_in(loaded, found), loaded, split), loaded)
    views = tuple(truth_views(loaded, found))
    digests = {"views": _digest_views(views), "truth": _digest_truth(found)}
    return Question(chosen, folder, loaded, found, views, digests, inputs, labels)


def _edit_inputs(name: str, given: dict[str, Any]) -> dict[str, Any]:
    """Take the inputs of an edit's protocol out of the options."""
    wanted = EDIT_INPUTS.get(name, ())
    missing = [key for key in wanted if key not in given]
    if missing:
        words = ", ".join(
            f"{key}={'FILE' if key == 'before' else 'COLOUR' if key == 'rgb' else 'CLASS'}" for key in missing
        )
        raise ValueError(
            f"set: expected {words} with {name} (what the splat was before, and what was edited), got none; add it"
        )
    inputs = {key: given.pop(key) for key in wanted}
    if "before" in inputs and not as_path(inputs["before"]).is_file():
        raise FileNotFoundError(f"{inputs['before']}: no such file; expected the splat before the edit there")
    if "rgb" in inputs:
        inputs["rgb"] = parse_color(inputs["rgb"], "rgb")
    return inputs


def _ask_teacher(protocol: Any, folder: Path, scene: Scene, truth: str | Path | None, split: str | None) -> Question:
    maps = as_path(truth) if truth is not None else folder / "features"
    if not maps.is_dir():
        raise FileNotFoundError(
            f"truth: expected the teacher's feature maps, got {maps}, which is no folder; name the folder that has them"
        )
    views = _views(scene, split or "all")
    chosen = protocol.chosen(views)
    teacher = read_teacher(maps, scene, chosen)
    files = FeatureFolder(maps, [view.stem for view in chosen]).files
    digests = {"views": _digest_views(chosen), "truth": digest_data(list(files))}
    return Question(protocol, folder, scene, teacher, tuple(views), digests, {})


def read_teacher(folder: Path, scene: Scene, views: Sequence[View], align_corners: bool = True) -> TeacherMethod:
    """The maps of some views as a method, see `maps_of_views`.

    Raises:
        FileNotFoundError: if a view has no map.
    """
    index = {scene.stem(i): i for i in range(len(scene))}
    places = [index[view.stem] for view in views]
    read = maps_of_views(scene, places, FeatureFolder(folder).of(scene, places))
    by_stem = ReadWhenAsked({view.stem: partial(read.__getitem__, i) for i, view in enumerate(views)})
    return TeacherMethod(by_stem, f"teacher ({folder.name})", align_corners=align_corners)


def _views(scene: Scene, split: str) -> list[View]:
    return [View(scene.stem(i), scene.cameras[i]) for i in scene.views(split)]


def _of_split(truth: Any, scene: Scene, split: str | None) -> Any:
    """The truth of a split's views."""
    labels = isinstance(truth, LabelTruth)
    known: Mapping[str, Any] = truth.maps if labels else truth.frames
    if split is None:
        test = {scene.stem(i) for i in scene.splits.get("test", ())} if labels else set()
        chosen = [stem for stem in known if stem in test] or list(known)
    else:
        wanted = {view.stem for view in _views(scene, split)}
        chosen = [stem for stem in known if stem in wanted]
        if not chosen:
            raise ValueError(
                f"split: expected one whose views have ground truth, got {split!r}: none of its {len(wanted)} views is among "
                f"the {len(known)} pictures with truth; choose another"
            )
    kept = ReadWhenAsked({stem: partial(known.__getitem__, stem) for stem in chosen})
    return replace(truth, maps=kept) if labels else replace(truth, frames=kept)


def _as_viewed(truth: Any, scene: Scene) -> Any:
    """Label pictures as the scene's views are, see `labels_of_view`."""
    distorted = {scene.stem(i) for i, lens in enumerate(scene.lenses or ()) if lens.distortion is not None}
    if isinstance(truth, MaskTruth):
        if distorted & set(truth.frames):
            raise ValueError(
                "truth: expected masks of pictures without lens distortion, got distorted ones; undistort pictures and masks"
            )
        return truth

    index = {scene.stem(i): i for i in range(len(scene)) if scene.stem(i) in distorted or changing_files(scene, i)}

    def read(stem: str) -> Tensor | Path:
        labels: Tensor | Path = truth.maps[stem]
        return labels_of_view(scene, index[stem], _labels(labels)) if stem in index else labels

    return replace(truth, maps=ReadWhenAsked({stem: partial(read, stem) for stem in truth.maps})) if index else truth


def _labels(found: Tensor | Path) -> Tensor:
    return found if isinstance(found, Tensor) else load_label_map(found)


def _digest_views(views: Sequence[View]) -> str:
    cameras = [(view.stem, view.camera) for view in views]
    return digest_data([[stem, c.viewmat, c.K, *c.size, *(c.origin if any(c.origin) else ())] for stem, c in cameras])


def _digest_truth(truth: LabelTruth | MaskTruth) -> str:
    """Of what is scored, as it was read; one picture in memory at a time."""
    if isinstance(truth, LabelTruth):
        return digest_data([list(truth.names), [[stem, digest_data(_labels(truth.maps[stem]))] for stem in truth.maps]])
    masks = [[stem, digest_data({k: list(v) for k, v in truth.frames[stem].items()})] for stem in truth.frames]
    return digest_data([*masks, list(truth.listed)] if truth.listed else masks)


def _digest_scene(scene: Scene, folder: Path, protocol: Any, inputs: Mapping[str, Any]) -> str:
    """Of the photographs and their masks; of an edit, of the labels, the surfaces, the splat before and the class."""
    indices = scene.views(protocol.split)
    if not inputs:
        masks = [] if scene.masks is None else [mask for i in indices if (mask := scene.masks[i]) is not None]
        return digest_data([*(scene.image_paths[i] for i in indices), *masks])
    files = [
        folder / "classes.json",
        folder / "surface.npz",
        *(folder / "labels" / f"{scene.stem(i)}.png" for i in indices),
    ]
    there = [file for file in files if file.is_file()]
    return digest_data([there, {key: as_path(value) if key == "before" else value for key, value in inputs.items()}])


def colors_of(found: Any, name: str) -> Gaussians:
    """The Gaussians with colours of a method or of a splat.

    Raises:
        ValueError: if it has none.
    """
    cloud = found if isinstance(found, Gaussians) else found.gaussians
    if cloud is None or cloud.sh is None:
        raise ValueError(
            f"field: expected Gaussians with colours for {name}, got none in it; name a colour splat, or a run with color.ply"
        )
    return cloud.replace(sh=cloud.sh.to(torch.float32))
