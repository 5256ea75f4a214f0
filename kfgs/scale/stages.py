"""The stages of a scene, as tasks: functions of paths and plain values, which a worker imports and calls.

Each stage calls the function that does it on one machine, and then writes `done/<stage>.json`: the key of its inputs, its result
and its files. A task whose description is there, with this key and all files, returns the result at once. While the stage is
made, its description has no key, so a killed task leaves nothing that counts as finished. Inputs are known by names, sizes and
times; where only times differ, the stage's own cache, which goes by content, finds its work.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from .._files import InUseError, digest_value, foreign, read_json, write_json
from ..evaluation import LabelSet
from ..features import FeatureFolder, Picture, discard_maps, extract_features, join_features, pictures_of
from ..fields import SemanticField
from ..fields.remembered import CLASSES
from ..labels import load_label_set
from ..pipeline import fit_scene, segment_scene, true_labels
from ..pipeline.evaluate import evaluate
from ..pipeline.train import training_device
from ..scenes import Scene, SceneError, is_scene, link_images, list_images, load_scene, run_sfm
from ..teachers.load import load_teacher
from ..teachers.protocol import Teacher, identify
from .options import BatchOptions, Job
from .places import WRITER, Place, inside, open_place

PATIENCE = 120  # seconds to wait for a folder in which a process works that was taken for dead
PROTOCOL = "kfgs-pooled/1"
TRUTH = ("labels_scored", "labels")
RESULTS = {"sfm": ("report",), "fit": ("gaussians", "latents"), "evaluate": ("miou",)}
"""What others read of the results of stages."""
Report = Callable[[str], None]

_loaded: dict[str, Teacher] = {}
_loading = threading.Lock()


def find_scene(job: Job, *, report: Report) -> dict[str, Any]:
    """Find the cameras of photos (sfm), and list what is left to do: pictures, keys of the stages, finished stages."""
    with _work(job) as (source, out):
        listing = source.listing()
        maps = inside("features") if job.options.teacher is not None else inside()
        source.fetch(lambda name: not maps(name))
        keys = {"photos": _key(source.marks((name for name in listing if not maps(name)), listing))}
        if photos := _photos(source):
            config = job.options.sfm_config
            keys["sfm"] = _key(keys["photos"], asdict(config))
            model = "scene/sparse/0"
            if not out.read_json(_description("sfm")) and any(map(inside(model), out.listing())):
                raise foreign(f"{job.out}/{model}", WRITER)

            def make() -> dict[str, Any]:
                made = run_sfm(source.path / photos, out.path / "scene", config=config, replace=True)
                if type(out) is Place:
                    link_images(source.path / photos, out.path / "scene")
                return {"registered": made.registered, "images": made.total, "report": str(made)}

            report(_stage(out, "sfm", keys["sfm"], ("scene/sparse",), (), make)["report"])
        out.fetch(inside("scene"))
        scene = _load(source, out)
        for note in scene.notes:
            report(f"note: {note}")
        views = {name: len(scene.views(name)) for name in ("train", "test") if scene.splits.get(name)}
        pictures = [[one.stem, _relative(one.path, source)] for one in pictures_of(scene, job.options.fit.split)]
        return {
            "views": views,
            "pictures": pictures,
            "split": "test" if views.get("test") else job.options.fit.split,
            "classes": _class_files(job, source) is not None,
            "labels": _truth(source) is not None and _counts_alike(job, source, report),
            **_keys_of(job, keys, listing, pictures, source, out),
        }


def _keys_of(
    job: Job, keys: dict[str, str], listing: dict[str, Any], pictures: list[list[str]], source: Place, out: Place
) -> dict[str, Any]:
    """The keys of the stages, each with everything that decides its result; and which of them are finished."""
    options, names = job.options, [name for _, name in pictures]
    if options.teacher is not None:
        keys["features"] = _key(identify(_teacher(options)), source.marks(names, listing))
    else:
        keys["features"] = _key(source.marks(filter(inside("features"), listing), listing))
    keys["fit"] = _key(keys["photos"], keys.get("sfm"), keys["features"], asdict(options.fit), version("kfgs"))
    words = _class_files(job, source) or []
    table = [[str(file), file.stat().st_size, file.stat().st_mtime_ns] for file in words] if options.text else []
    keys["segment"] = _key(keys["fit"], table, options.pictures)
    keys["evaluate"] = _key(keys["fit"], table, PROTOCOL)
    files = out.listing()
    done = {stage: about["result"] for stage, key in keys.items() if (about := _finished(out, stage, key, files))}
    return {"keys": keys, "done": done}


def encode_part(job: Job, pictures: list[list[str]], *, report: Report) -> dict[str, Any]:
    """Encode some pictures, [stem, relative name] each, by the worker's teacher.

    A part is called by its pictures, so that one of another division never has its name.
    """
    with _work(job) as (source, out):
        teacher, word = _teacher(job.options), _key([stem for stem, _ in pictures])
        key = _key(identify(teacher), source.marks(name for _, name in pictures))
        files = tuple(f"features/{stem}.npy" for stem, _ in pictures)

        def make() -> dict[str, Any]:
            out.fetch(_is_manifest)
            source.fetch(inside(*(name for _, name in pictures)))
            chosen = [Picture(stem, source.path / name) for stem, name in pictures]
            extract_features(teacher, chosen, out.path / "features", part=word, report=report)
            return {"maps": len(chosen)}

        return _stage(out, f"features-{word}", key, files, files, make)


def join_parts(job: Job, key: str, stems: list[str], *, report: Report) -> dict[str, Any]:
    """Join the manifests of all parts."""
    with _work(job) as (_, out):

        def make() -> dict[str, Any]:
            out.fetch(_is_manifest)
            join_features(out.path / "features", stems)
            return {"maps": len(stems)}

        return _stage(out, "features", key, ("features",), (), make)


def fit(job: Job, key: str, *, report: Report) -> dict[str, Any]:
    """Make the field, and delete the maps if that was asked for."""
    with _work(job) as (source, out):
        options = job.options

        def make() -> dict[str, Any]:
            source.fetch(lambda name: options.teacher is None or not inside("features")(name))
            scene = _load(source, out)
            folder = (source if options.teacher is None else out).path / "features"
            if not folder.is_dir():
                raise SceneError(
                    f"{job.source}: expected feature maps in features/, got none; name a teacher (--teacher)"
                )
            maps = FeatureFolder(folder).of(scene, options.fit.split)
            found = fit_scene(scene.undistorted(), maps, out.path, options.fit, report=report).field
            return {"gaussians": len(found), "latents": found.features.shape[1]}

        result = _stage(out, "fit", key, ("field",), ("features", "scene", "stages", "field", "color.ply"), make)
        if options.discard_features and options.teacher is not None and (out.path / "features").is_dir():
            discard_maps(out.path / "features")
            out.store()
        return result


def segment(job: Job, key: str, split: str, *, report: Report) -> dict[str, Any]:
    """Segment the views of a split."""
    with _work(job) as (source, out):

        def make() -> dict[str, Any]:
            source.fetch(lambda name: not inside("features")(name))
            scene, truth = _load(source, out).undistorted(), _truth(source)
            known = {} if truth is None else true_labels(scene, truth, split)
            made = segment_scene(
                SemanticField.load(out.path / "field"),
                scene,
                _classes(job, source),
                out.path / "segmented",
                split=split,
                pictures=job.options.pictures,
                truth=known,
            )
            return {"views": len(made)}

        return _stage(out, "segment", key, ("segmented",), ("field", "scene"), make)


def score(job: Job, key: str, *, report: Report) -> dict[str, Any]:
    """Score the field against the true labels."""
    with _work(job) as (source, out):

        def make() -> dict[str, Any]:
            source.fetch(lambda name: not inside("features")(name))
            photos = _photos(source)
            folder, images = (source.path, None) if not photos else (out.path / "scene", source.path / photos)
            found = evaluate(
                out.path / "field",
                folder,
                PROTOCOL,
                encode=_classes(job, source),
                truth=_truth(source),
                images=images,
                command=WRITER,
            )
            write_json(out.path / "scores.json", found.to_json())
            report(str(found))
            return {"miou": found.to_json()["scores"]["mIoU"]}

        return _stage(out, "evaluate", key, ("scores.json",), ("field", "scene"), make)


@contextmanager
def _work(job: Job) -> Iterator[tuple[Place, Place]]:
    """The places of a scene and its run, with the threads of a task."""
    torch.set_num_threads(job.options.threads)
    with open_place(job.source) as source, open_place(job.out) as out:
        yield source, out


def _is_manifest(name: str) -> bool:
    """Whether a file of a run is a manifest of maps, of all or of a part."""
    return name.startswith("features/features.") and name.endswith(".json")


def _key(*parts: Any) -> str:
    return digest_value(parts)[:16]


def _description(stage: str) -> str:
    return f"done/{stage}.json"


def _finished(out: Place, stage: str, key: str, files: dict[str, Any]) -> dict[str, Any] | None:
    """The description of a stage with this key whose files are all there, in their sizes. A damaged one does not count."""
    about = out.read_json(_description(stage))
    result, made = about.get("result"), about.get("files")
    if about.get("key") != key or not isinstance(result, dict) or not isinstance(made, dict):
        return None
    whole = all(name in files and files[name][0] == size for name, size in made.items())
    return about if whole and set(RESULTS.get(stage, ())) <= set(result) else None


def _stage(
    out: Place,
    stage: str,
    key: str,
    makes: Sequence[str],
    needs: Sequence[str],
    make: Callable[[], dict[str, Any]],
) -> dict[str, Any]:
    """A stage's result, found or made; `makes` are its files and folders in the run, `needs` those that it reads."""
    about = _finished(out, stage, key, out.listing())
    if about is not None:
        return {**about["result"], "reused": True}
    out.write_json(_description(stage), {"key": None})  # begun: from now on, its files there are ours
    out.fetch(inside(*needs))
    result = _patiently(make)
    out.store()
    made = inside(*makes)
    files = {name: mark[0] for name, mark in out.listing().items() if made(name)}
    out.write_json(_description(stage), {"key": key, "result": result, "files": files})
    return {**result, "reused": False}


def _patiently(make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Call a function again while another process works in its folder: a worker that lost its connection may still do."""
    end = time.monotonic() + PATIENCE
    while True:
        try:
            return make()
        except InUseError:
            if time.monotonic() > end:
                raise
            time.sleep(1)


def _teacher(options: BatchOptions) -> Teacher:
    """The teacher of this process, loaded once."""
    assert options.teacher is not None
    device = training_device(options.fit.device)
    weights = [] if options.weights is None else [options.weights, *_stamp(Path(options.weights))]
    key = _key(options.teacher, weights, dict(options.teacher_options), str(device))
    with _loading:
        if key not in _loaded:
            _loaded.clear()
            teacher = load_teacher(options.teacher, options.weights, **options.teacher_options)
            _loaded[key] = teacher.to(device) if hasattr(teacher, "to") else teacher
        return _loaded[key]


def _stamp(path: Path) -> list[int]:
    return [path.stat().st_size, path.stat().st_mtime_ns] if path.is_file() else []


def _photos(source: Place) -> str | None:
    """The folder of photos of a place without poses, as a relative name; None if it has poses."""
    if not source.path.is_dir():
        raise FileNotFoundError(f"{source.path}: no such folder; expected a scene or photos there")
    if is_scene(source.path):
        return None
    found = next(
        (name for name in ("images", ".") if (source.path / name).is_dir() and list_images(source.path / name)), None
    )
    if found is None:
        raise SceneError(
            f"{source.path}: expected a COLMAP model, a transforms.json, or photos to find their cameras, got none of them; name "
            "the folder of a scene"
        )
    return found


def _load(source: Place, out: Place) -> Scene:
    """The scene, with the cameras that sfm found if it has none of its own."""
    photos = _photos(source)
    return load_scene(source.path) if photos is None else load_scene(out.path / "scene", images=source.path / photos)


def _relative(path: Path, source: Place) -> str:
    try:
        return path.relative_to(source.path).as_posix()
    except ValueError:  # a transforms.json may name pictures elsewhere on this machine
        return str(path.absolute())


def _truth(source: Place) -> Path | None:
    return next((source.path / name for name in TRUTH if (source.path / name).is_dir()), None)


def _counts_alike(job: Job, source: Place, report: Report) -> bool:
    """Whether the numbers in true labels mean the classes of the table for all scenes, if there is one."""
    listed = source.path / "classes.json"
    if job.text_file is None or (listed.is_file() and tuple(read_json(listed)) == load_label_set(job.text_file).names):
        return True
    report(
        f"note: not scored: the scene's labels count the classes of its classes.json, and {job.text_file} has others"
    )
    return False


def _class_files(job: Job, source: Place) -> list[Path] | None:
    """The files of the label set: the table for all scenes, or the scene's own; None if there is none."""
    if job.text_file is not None:
        return [job.text_file]
    choices = ([source.path / name for name in names] for names in CLASSES)
    return next((files for files in choices if all(file.is_file() for file in files)), None)


def _classes(job: Job, source: Place) -> LabelSet:
    files = _class_files(job, source)
    assert files is not None
    return load_label_set(*files)
