"""Score a result under a named protocol: a field of kfgs, the teacher itself, a colour splat, or any other method."""

from __future__ import annotations

import os
import platform
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch

from .._card import short_repr
from .._files import as_path, file_stem
from ..evaluation import FieldMethod, Method, Report, TeacherMethod, View
from ..evaluation.method import Labeller, LabelRule
from ..evaluation.protocols import get_protocol
from ..evaluation.teacher_agreement import TeacherAgreement
from ..evaluation.texts import Encode, as_encoder
from ..evaluation.truth import ReadWhenAsked
from ..fields import SemanticField
from ..fields.store import find_field
from ..formats import read_splats
from ..gaussians import Gaussians
from ..labels import LabelSet
from ..scenes import FeatureFolder, Scene, load_scene
from ..scenes.scene import make_split
from .maps import maps_of_views

MAPS = ("features.json", "*_fmap_CxHxW.pt", "*.npy")  # files in a folder of feature maps


class Question(NamedTuple):
    """What a method is asked: the same for every method that is compared."""

    protocol: Any  # of `kfgs.evaluation.protocols.PROTOCOLS`, or an object with the same members
    scene: Scene  # without distortion
    truth: Any  # what the protocol compares with
    views: Sequence[View]  # none if points are scored

    def __repr__(self) -> str:
        return short_repr(self)

    @property
    def scored(self) -> Sequence[View]:
        """The views that the protocol chooses."""
        return getattr(self.protocol, "chosen", list)(self.views)  # type: ignore[no-any-return]


def open_question(
    scene: str | Path,
    protocol: Any = "kfgs-pooled/1",
    *,
    truth: str | Path | None = None,
    split: str | None = None,
    images: str | Path | None = None,
) -> Question:
    """Read a scene and its ground truth for a protocol.

    Args:
        scene: its folder.
        protocol: a name of `kfgs.evaluation.protocols.PROTOCOLS`, or a protocol.
        truth: where the ground truth is, if not in the scene's folder (`find_labels`, `find_points`). For
            `feature3dgs-teacher/1` the folder of the teacher's maps; None: `features/` in the scene.
        split: which views of the scene's own splits. None depends on the protocol: the test views (`df3dgs/1`: those of the
            paper's split), or all views with labels if no test view has some; of a teacher's maps all views.
        images: folder of the pictures.

    A FileNotFoundError if the scene or its truth is missing, a ValueError if protocol, split or truth do not fit.
    """
    protocol = get_protocol(protocol) if isinstance(protocol, str) else protocol
    folder, place = as_path(scene), None if truth is None else as_path(truth)
    loaded = load_scene(folder, images=images).undistorted()
    if split is None and (rule := getattr(protocol, "scene_split", None)) is not None:
        loaded = replace(loaded, splits=make_split(len(loaded), rule))
    if not isinstance(protocol, TeacherAgreement):
        return Question(protocol, loaded, *protocol.open(loaded, folder, place, split))
    maps = place or folder / "features"
    if not maps.is_dir():
        raise FileNotFoundError(f"truth: expected a folder of the teacher's feature maps, got {maps}; name another")
    views = [View(loaded.stem(i), loaded.cameras[i]) for i in loaded.views(split or "all")]
    return Question(protocol, loaded, _read_teacher(maps, loaded, protocol.chosen(views), align_corners=True), views)


def evaluate(
    field: str | Path | SemanticField | Method | Gaussians,
    question: Question,
    *,
    encode: Encode | LabelSet | None = None,
    labels: LabelRule | None = None,
    command: str = "",
) -> Report:
    """Score a result under a protocol.

    Args:
        field: a field or run of kfgs, a folder of a teacher's feature maps, or any `Method`. For `kfgs-color/1` Gaussians with
            colours, a splat, or a run that has one.
        question: from `open_question`; several results can be asked the same.
        encode: a label set, or the teacher's text encoder. Not needed for colours. `feature3dgs-teacher/1` asks the classes of
            a label set, and LSeg's words of a text encoder.
        labels: who decides the class of a field's pixel (`rule` of `FieldMethod`). None: the protocol's (`rule`).
        command: kept in the report.

    Raises:
        FileNotFoundError: if the result is missing.
        ValueError: if something does not fit, such as texts without embeddings.
        TypeError: if a protocol of Gaussians is asked about a teacher, or `question` is no Question.
    """
    if not isinstance(question, Question):
        got = type(question).__name__
        raise TypeError(f"question: expected a Question, got {got}; call open_question(scene, protocol)")
    scorer, rule = question.protocol, getattr(question.protocol, "rule", None)
    if labels is not None and rule is None:
        raise ValueError(f"labels: expected none with {scorer.name}, which takes no class per pixel, got {labels!r}")
    method: Any = open_result(field, question) if isinstance(field, str | Path) else field
    if isinstance(method, SemanticField):
        method = FieldMethod(method)
    if getattr(scorer, "of_colors", False):
        if not isinstance(method, Gaussians) or method.sh is None:
            raise ValueError(f"field: expected Gaussians with colours for {scorer.name}, got none; name a colour splat")
        report: Report = scorer.score(method.replace(sh=method.sh.to(torch.float32)), question.truth)
    else:
        if isinstance(method, FieldMethod) and rule is not None and (labels is not None or method is not field):
            method = FieldMethod(method.field, method.name, rule=labels or rule)
        if isinstance(scorer, TeacherAgreement) and isinstance(encode, LabelSet) and scorer.texts is None:
            scorer = replace(scorer, texts=encode.names)
        report = scorer.score(method, question.truth, list(question.views), as_encoder(encode))
    if rule is not None and isinstance(method, Labeller):
        used = getattr(method, "rule", "own")
        unusual = ("labels",) if used != rule else ()
        report = replace(report, options={**report.options, "labels": used}, changed=(*report.changed, *unusual))
    notes = (*report.notes, *_notes(question, method, encode))
    return replace(report, notes=notes, command=command, machine=this_machine())


def open_result(path: str | Path, question: Question) -> Method | Gaussians:
    """Read a result as a method that the question's protocol can score; for colours, Gaussians."""
    path, name = as_path(path), question.protocol.name
    field = find_field(path)
    if getattr(question.protocol, "of_colors", False):
        splat = path if path.is_file() and field != path else (path.parent if field == path else path) / "color.ply"
        if not splat.is_file():
            raise FileNotFoundError(f"{splat}: no such file; expected a colour splat for {name}")
        return read_splats(splat)
    if field is not None:
        return FieldMethod(SemanticField.load(field))
    if not path.is_dir() or (path / "images").is_dir() or not any(any(path.glob(pattern)) for pattern in MAPS):
        raise ValueError(
            f"field: expected a field or a finished run of kfgs, or a folder of feature maps, got {path}; results of other "
            "programs are scored by benchmarks/protocols.py"
        )
    if not question.views:
        raise TypeError(f"field: expected one with Gaussians for {name}, got maps of a teacher: {path}")
    return _read_teacher(path, question.scene, question.scored)


def _read_teacher(folder: Path, scene: Scene, views: Sequence[View], *, align_corners: bool = False) -> TeacherMethod:
    index = {scene.stem(i): i for i in range(len(scene))}
    places = [index[view.stem] for view in views]
    maps = maps_of_views(scene, places, FeatureFolder(folder).of(scene, places))
    by_stem = ReadWhenAsked({view.stem: partial(maps.__getitem__, i) for i, view in enumerate(views)})
    return TeacherMethod(by_stem, f"teacher ({folder.name})", align_corners=align_corners)


def _notes(question: Question, method: Any, encode: Any) -> list[str]:
    """Facts that decide how a score is to be read; what is not known is left out."""
    views, scene = question.scored, question.scene
    field = method.field if isinstance(method, FieldMethod) else None
    names = [] if field is None else field.info.get("views") or [camera.name for camera in field.cameras]
    trained, scored = {file_stem(str(name)) for name in names}, {view.stem for view in views}
    both = len(trained & scored)
    notes = [f"{both} of {len(views)} scored views were trained on"] if both else []
    split = getattr(question.protocol, "scene_split", None)
    for name, stems, what in (("test", scored, "scored"), ("train", trained, "trained")):
        own = set() if split is None else {scene.stem(i) for i in make_split(len(scene), split)[name]}
        if own and stems:
            notes.append(f"split {split}: {len(own & stems)} of the {len(stems)} views {what} are its {name} views")
    sizes = sorted({view.camera.size for view in views}, key=lambda size: size[0] * size[1])
    if sizes:
        several = [f"{height}x{width}" for height, width in dict.fromkeys((sizes[0], sizes[-1]))]
        notes.append(f"scored pictures: {len(views)} of {' to '.join(several)} (height x width)")
    known = [source.info.get("teacher") for source in (field, encode) if isinstance(source, SemanticField | LabelSet)]
    teachers = [teacher.get("name") for teacher in known if isinstance(teacher, dict)]
    teachers.append(getattr(getattr(encode, "__self__", None), "name", None))  # of a teacher's method `encode_text`
    return notes + [f"teacher: {name}" for name in teachers if name is not None][:1]


def this_machine() -> str:
    """Processor, threads, GPU if there is one, and the version of torch, in a line."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        line = re.search(r"model name\s*:\s*(.+)", info.read_text(encoding="utf-8", errors="replace"))
        model = line[1].strip() if line else model
    gpu = f", {torch.cuda.get_device_name()}" if torch.cuda.is_available() else ""
    return f"{model}, {torch.get_num_threads()} of {os.cpu_count()} threads{gpu}, torch {torch.__version__}"
