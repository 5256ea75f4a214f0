"""One scene of a batch from its photos to its scores: steps, each of which finds what an earlier call has finished."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from .._check import check_whole
from .._files import as_path, read_json, write_json
from .._notes import is_strict
from ..fields.store import scene_classes
from ..labels import load_label_set
from ..pipeline import Paper, Uplift, fit, score_scene, segment_scene, true_labels
from ..pipeline.segment import scored_labels
from ..pipeline.train import training_device
from ..scenes import FeatureFolder, Scene, SceneError, SfmConfig, extract_features, list_images, load_scene, run_sfm
from ..scenes.load import is_scene
from ..scenes.sfm import link_images
from ..teachers.load import load_teacher
from ..teachers.protocol import Teacher


@dataclass(frozen=True)
class BatchOptions:
    """Options of `run_batch`, the same for all scenes. Workers receive them, so they hold paths and plain values."""

    teacher: str | None = None
    """Name of the network that makes feature maps, see `load_teacher`; None: each scene has its maps in `features/`."""
    weights: str | None = None
    """The teacher's weights: a file or folder that every worker can read, or a hub id."""
    teacher_options: Mapping[str, Any] = field(default_factory=dict)
    """The teacher's options."""
    sfm: SfmConfig = field(default_factory=SfmConfig)
    """For folders of photos without poses; `num_threads` follows `threads`."""
    method: Uplift | Paper = field(default_factory=Uplift)
    """How fields are made."""
    text: str | None = None
    """Table of `kfgs features --words` for all scenes; None: each scene's `classes.json` and `text.npy` or `text.safetensors`."""
    pictures: int = 4
    """How many views of a scene get a sheet, an overlay and a picture of features."""
    threads: int = 1
    """Threads of each task. Equal numbers of threads give equal bits, however many workers there are."""
    discard_features: bool = False
    """Delete a scene's feature maps when its field is made."""
    strict: bool = field(default_factory=is_strict)
    """Refuse scenes of which something broken would be left out (`--strict`)."""

    def __post_init__(self) -> None:
        check_whole("threads", self.threads, 1)
        check_whole("pictures", self.pictures, 0)
        for name in ("weights", "text"):  # workers run in other folders
            value = getattr(self, name)
            if value is not None and as_path(value).exists():
                object.__setattr__(self, name, str(as_path(value).absolute()))


def make_scene(
    source: Path,
    run: Path,
    options: BatchOptions,
    step: Callable[[str], AbstractContextManager[None]],
    say: Callable[[str], None],
) -> dict[str, Any]:
    """Make the field of a scene or a folder of photos in the folder `run`, segment its test views and score them.

    `step` is a context for each step, `say` receives notes. Returns `gaussians`, `latents`, `miou` (None without true labels).
    """
    maps = source / "features"
    with step("cameras"):
        scene = _load(source, run / "scene", replace(options.sfm, num_threads=options.threads), say)
    for note in scene.notes:
        say(f"note: {note}")
    if options.teacher is not None:
        maps = run / "features"
        with step("features"):
            extract_features(_teacher(options.teacher, options), scene, maps)
    elif not maps.is_dir():
        raise SceneError(f"{source}: expected feature maps in features/, got none; name a teacher (--teacher)")
    with step("fit"):
        made = fit(scene.undistorted(), FeatureFolder(maps).of(scene), options.method, folder=run, report=say)
    if options.discard_features and options.teacher is not None:
        shutil.rmtree(maps)
    value: dict[str, Any] = {"gaussians": len(made), "latents": made.latents.shape[1], "miou": None}
    classes = scene_classes(source) if options.text is None else load_label_set(options.text)
    if classes is None:
        return value
    with step("segment"):
        scene, shown = scene.undistorted(), "test" if scene.splits.get("test") else "train"
        known, drawn = scored_labels(source, classes, say), options.pictures
        truth = {} if known is None else true_labels(scene, known, shown)
        labels = segment_scene(made, scene, classes, run / "segmented", split=shown, pictures=drawn, truth=truth)
        if truth:
            report = score_scene(labels, truth, classes)
            write_json(run / "scores.json", {"scene": run.name, **report.to_json()})
            say(str(report))
            value["miou"] = float(report.miou.value)
    return value


def _load(source: Path, posed: Path, config: SfmConfig, say: Callable[[str], None]) -> Scene:
    """The scene; if it has no poses, they are estimated from its photos and written to `posed`."""
    if is_scene(source):
        return load_scene(source)
    photos = next((place for place in (source / "images", source) if place.is_dir() and list_images(place)), None)
    if photos is None:
        raise SceneError(f"{source}: expected a COLMAP model, a transforms.json or photos, got none of them")
    say(f"note: no poses in {source}: no COLMAP model, no transforms.json; sfm finds its cameras from the photos")
    facts, noted = {"photos": stamps(photos), "config": asdict(config)}, posed / "sfm.json"
    if not noted.is_file() or read_json(noted) != facts:
        try:
            run_sfm(photos, posed, config=config, replace=True)
        except SceneError as error:
            advice = f"try other options or photos: `kfgs sfm {photos} --out SCENE`, and put SCENE into the list"
            raise SceneError(f"no cameras found; {advice}. sfm says: {error}") from error
        link_images(photos, posed)
        write_json(noted, facts)
    return load_scene(posed, images=photos)


def stamps(folder: Path, skip: str | None = None) -> list[list[Any]]:
    """[name, size, time] of each file below a folder but in `skip`. Links are followed, but not back to a folder seen before."""
    files, seen = list[Path](), {os.path.realpath(folder / (skip or "."))}
    for here, folders, names in os.walk(folder, followlinks=True):
        seen.add(os.path.realpath(here))
        folders[:] = [name for name in sorted(folders) if os.path.realpath(os.path.join(here, name)) not in seen]
        files += [file for file in (Path(here, name) for name in sorted(names)) if file.is_file()]
    return [[file.relative_to(folder).as_posix(), file.stat().st_size, file.stat().st_mtime_ns] for file in files]


_loaded: dict[str, Teacher] = {}


def _teacher(name: str, options: BatchOptions) -> Teacher:
    """The teacher of this worker process, loaded once."""
    if (key := repr((name, options.weights, options.teacher_options))) not in _loaded:
        _loaded.clear()
        teacher = load_teacher(name, options.weights, **options.teacher_options)
        _loaded[key] = teacher.to(training_device()) if hasattr(teacher, "to") else teacher
    return _loaded[key]
