"""The stages of a scene, as tasks: functions of paths and plain values, which a worker imports and calls.

Each stage calls the function that does it on one machine, and then writes `done/<stage>.json`: the key of its inputs, its result
and its files. A task whose description is there, with this key and all files, returns the result at once. While the stage is
made, its description has no key, so a killed task leaves nothing that counts as finished. Inputs are known by names, sizes and
times; where only times differ, the stage's own cache, which goes by content, finds its work.
"""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from .._files import InUseError, digest_value, write_json
from .._notes import hear
from ..features import FeatureFolder, Picture, discard_maps, extract_features, join_features, pictures_of
from ..fields import SemanticField
from ..fields.store import NAME
from ..pipeline import fit as fit_field
from ..pipeline import segment_scene, true_labels
from ..pipeline.evaluate import evaluate
from ..pipeline.train import training_device
from ..scenes import SceneError, link_images, run_sfm
from ..teachers.load import load_teacher
from ..teachers.protocol import Teacher, identify
from .options import BatchOptions, Job
from .places import AT_WORK, WRITER, Place, inside, open_place
from .scene_parts import class_files, classes_of, counts_alike, load, photos_of, relative, truth_of

PATIENCE = 120  # seconds to wait for a folder in which a process works that was taken for dead
PROTOCOL = "kfgs-pooled/1"
RESULTS = {"sfm": ("report",), "fit": ("gaussians", "latents"), "evaluate": ("miou",)}
"""What others read of the results of stages; in addition each has `seconds`, of the work that made it."""
Report = Callable[[str], None]

_loaded: dict[str, Teacher] = {}
_loading = threading.Lock()


def find_scene(job: Job, *, report: Report) -> dict[str, Any]:
    """Find the cameras of photos (sfm), and list what is left to do: pictures, keys of the stages, finished stages."""
    start, earlier = time.perf_counter(), 0.0
    with _work(job) as (source, out):
        listing = source.listing()
        maps = inside("features") if job.options.teacher is not None else inside()
        source.fetch(lambda name: not maps(name))
        keys = {"photos": _key(source.marks((name for name in listing if not maps(name)), listing))}
        if photos := photos_of(source):
            report(
                f"note: no poses in {job.source}: no COLMAP model and no transforms.json; its cameras are found from the photos "
                "(sfm). If it had poses before, put them back and start again"
            )
            config = job.options.sfm_config
            keys["sfm"] = _key(keys["photos"], asdict(config))

            def make() -> dict[str, Any]:
                with _advice(job.source, photos):
                    made = run_sfm(source.path / photos, out.path / "scene", config=config, replace=True)
                if type(out) is Place:
                    link_images(source.path / photos, out.path / "scene")
                return {"registered": made.registered, "images": made.total, "report": str(made)}

            cameras = _stage(out, "sfm", keys["sfm"], ("scene/sparse",), (), make)
            earlier = cameras["seconds"] if cameras["reused"] else 0.0
            report(cameras["report"])
        out.fetch(inside("scene"))
        scene = load(source, out)
        for note in scene.notes:
            report(f"note: {note}")
        views = {name: len(scene.views(name)) for name in ("train", "test") if scene.splits.get(name)}
        pictures = [[one.stem, relative(one.path, source)] for one in pictures_of(scene, job.options.split)]
        return {
            "views": views,
            "pictures": pictures,
            "split": "test" if views.get("test") else job.options.split,
            "classes": class_files(job, source) is not None,
            "labels": truth_of(source) is not None and counts_alike(job, source, report),
            **_keys_of(job, keys, listing, pictures, source, out),
            "seconds": earlier + time.perf_counter() - start,
        }


@contextmanager
def _advice(source: str, photos: str) -> Iterator[None]:
    """Say where the options are that sfm's errors name: a batch has none of them. That comes first: tables cut messages."""
    try:
        yield
    except SceneError as error:
        apart = photos == "."  # no model is written among the photos themselves
        place = source if apart else f"{source}/{photos}"
        todo = "SCENE`, and write SCENE into the list" if apart else f"{source}`, then this again with --retry-failed"
        said = str(error).removeprefix(f"{place}: ")
        raise SceneError(
            f"no cameras found; try other options or photos: `kfgs sfm {place} --out {todo}. sfm says: {said}"
        ) from error


def _keys_of(
    job: Job, keys: dict[str, str], listing: dict[str, Any], pictures: list[list[str]], source: Place, out: Place
) -> dict[str, Any]:
    """The keys of the stages, each with everything that decides its result; and which of them are finished."""
    options, names = job.options, [name for _, name in pictures]
    if options.teacher is not None:
        keys["features"] = _key(identify(_teacher(options)), source.marks(names, listing))
    else:
        keys["features"] = _key(source.marks(filter(inside("features"), listing), listing))
    keys["fit"] = _key(
        keys["photos"],
        keys.get("sfm"),
        keys["features"],
        options.method.options(),
        options.split,
        options.seed,
        version("kfgs"),
    )
    words = class_files(job, source) or []
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


def join_parts(job: Job, key: str, stems: list[str], seconds: float, *, report: Report) -> dict[str, Any]:
    """Join the manifests of all parts, which took some seconds."""
    with _work(job) as (_, out):

        def make() -> dict[str, Any]:
            out.fetch(_is_manifest)
            join_features(out.path / "features", stems)
            return {"maps": len(stems), "seconds": seconds}

        return _stage(out, "features", key, ("features",), (), make)


def fit(job: Job, key: str, *, report: Report) -> dict[str, Any]:
    """Make the field, and delete the maps if that was asked for."""
    with _work(job) as (source, out):
        options = job.options

        def make() -> dict[str, Any]:
            source.fetch(lambda name: options.teacher is None or not inside("features")(name))
            scene = load(source, out)
            folder = (source if options.teacher is None else out).path / "features"
            if not folder.is_dir():
                raise SceneError(
                    f"{job.source}: expected feature maps in features/, got none; name a teacher (--teacher)"
                )
            maps = FeatureFolder(folder).of(scene, options.split)
            made = fit_field(
                scene.undistorted(),
                maps,
                options.method,
                folder=out.path,
                split=options.split,
                seed=options.seed,
                device=options.device,
                report=report,
            )
            return {"gaussians": len(made), "latents": made.features.shape[1], "seconds": 0.0}

        result = _stage(out, "fit", key, (NAME,), ("features", "scene", "stages", NAME, "color.ply"), make)
        if options.discard_features and options.teacher is not None and (out.path / "features").is_dir():
            discard_maps(out.path / "features")
            out.store()
        return result


def segment(job: Job, key: str, split: str, *, report: Report) -> dict[str, Any]:
    """Segment the views of a split."""
    with _work(job) as (source, out):

        def make() -> dict[str, Any]:
            source.fetch(lambda name: not inside("features")(name))
            scene, truth = load(source, out).undistorted(), truth_of(source)
            known = {} if truth is None else true_labels(scene, truth, split)
            made = segment_scene(
                SemanticField.load(out.path),
                scene,
                classes_of(job, source),
                out.path / "segmented",
                split=split,
                pictures=job.options.pictures,
                truth=known,
            )
            return {"views": len(made)}

        return _stage(out, "segment", key, ("segmented",), (NAME, "scene"), make)


def score(job: Job, key: str, *, report: Report) -> dict[str, Any]:
    """Score the field against the true labels."""
    with _work(job) as (source, out):

        def make() -> dict[str, Any]:
            source.fetch(lambda name: not inside("features")(name))
            photos = photos_of(source)
            folder, images = (source.path, None) if not photos else (out.path / "scene", source.path / photos)
            found = evaluate(
                out.path / NAME,
                folder,
                PROTOCOL,
                encode=classes_of(job, source),
                truth=truth_of(source),
                images=images,
                command=WRITER,
            )
            write_json(out.path / "scores.json", {"scene": job.out.rpartition("/")[2], **found.to_json()})
            report(str(found))
            return {"miou": found.to_json()["scores"]["mIoU"]}

        return _stage(out, "evaluate", key, ("scores.json",), (NAME, "scene"), make)


@contextmanager
def _work(job: Job) -> Iterator[tuple[Place, Place]]:
    """The places of a scene and its run, with threads and `strict` of a task: later work of the process has its own again."""
    threads = torch.get_num_threads()
    torch.set_num_threads(job.options.threads)
    try:
        quiet = hear(lambda note: None, strict=job.options.strict)  # notes of scenes are reported
        with quiet, open_place(job.source) as source, open_place(job.out) as out:
            if type(out) is Place:
                with suppress(OSError):  # only shown to people
                    out.write_text(AT_WORK, f"process {os.getpid()} of {socket.gethostname()}\n")
            yield source, out
    finally:
        torch.set_num_threads(threads)


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
    if not isinstance(result.setdefault("seconds", 0.0), int | float):  # older ones do not say it
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
    """A stage's result, found or made; `makes` are its files and folders in the run, `needs` those that it reads.

    `make` returns `seconds` if earlier work is in what it makes.
    """
    about = _finished(out, stage, key, out.listing())
    if about is not None:
        return {**about["result"], "reused": True}
    out.write_json(_description(stage), {"key": None})  # begun: from now on, its files there are ours
    start = time.perf_counter()
    out.fetch(inside(*needs))
    result = _patiently(make)
    out.store()
    result["seconds"] = result.get("seconds", 0.0) + time.perf_counter() - start
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
    device = training_device(options.device)
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
