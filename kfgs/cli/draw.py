"""Commands that show what a field knows: render (films), segment (label pictures) and evaluate (scores)."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import kfgs

from .._files import check_output, write_json
from .ask import open_colors, open_meaning
from .files import is_field, open_field, say, wrote
from .options import Classes, Flag, Given, Positional, Teacher, Walk, Word

KEYS = 40  # cameras of a long walk that become keys: enough to follow it, few enough to smooth out a shaking hand
FPS = 15.0
TITLES = {"photo": "colours", "labels": "classes"}
FRAMES, WIDTH = 72, 480  # of a path without cameras of your own
OVERHEAD = "ceiling"  # left out of an orbit, which looks in from above


def render(
    source: Positional[Path],
    out: Path,
    *,
    path: Walk = "orbit",
    show: Given[str] = None,
    color: Given[Path] = None,
    frames: Given[int] = None,
    width: Given[int] = None,
    classes: Classes,
) -> None:
    """Make a film of a field or a labelled splat: an orbit, or a flight along its cameras or your own.

    Examples:
        kfgs render run/ --out tour.gif
        kfgs render run/ --path cameras --show photo,labels,query=chair --out tour.mp4
        kfgs render labelled.ply --path cameras --scene scene/ --out flight.gif
        kfgs render run/ --path my_cameras.json --out mine.mp4

    Args:
        source: A run folder, a field (RUN/field.kfgs), or a splat with classes.
        out: The film, .gif or .mp4 (which needs imageio-ffmpeg).
        path: orbit goes around the scene and looks in from above: what is in front is cut away, and a class "ceiling" is left
            out. cameras flies along the scene's cameras. A file or folder (transforms.json, COLMAP model, scene; without
            pictures, too) gives cameras of your own: exactly these, in the order of their names; or with --frames a smooth path.
        show: What stands side by side, with commas between: photo (the colours), labels, features, query=TEXT. By default
            photo,labels, or labels if there are no colours.
        color: Colour splat in the same frame; by default that of the run, or that which the field was made on.
        frames: Number of pictures; by default 72, or one for each camera of your own.
        width: Of a picture, pixels; by default 480, or that of your own cameras.
    """
    from tqdm import tqdm

    from ..viz import save_animation
    from ..viz.films import check_target

    check_output("out", out, "a file")
    check_target(out, FPS, "out")
    walk_of = read_walk(path, frames)
    meaning, cameras = open_meaning(source, classes, Teacher(), labelled=True)
    if classes.loaded is not None:
        cameras = classes.loaded.cameras
    semantic, colors = meaning.gaussians.replace(names=meaning.names), open_colors(source, color, meaning)
    colors = None if colors is None else colors.with_origin(semantic.origin)
    if path == "orbit":
        semantic, colors = _opened(meaning.names, semantic, colors)
    words = [word.strip() for word in (show or ("labels" if colors is None else "photo,labels")).split(",")]
    shows = {TITLES.get(word, word.removeprefix("query=")): _show(word, meaning, semantic, colors) for word in words}
    walk = walk_of(semantic if colors is None else colors, cameras)
    if width is not None:
        walk = [camera.resized(max(1, round(width * camera.height / camera.width)), width) for camera in walk]
    legend = semantic if "labels" in words else None
    with tqdm(total=len(walk), desc="render", unit="frame") as bar:
        save_animation(out, shows, walk, fps=FPS, legend=legend, progress=lambda *_: bar.update())
    wrote([out])


def _opened(names: Any, semantic: Any, colors: Any) -> tuple[Any, Any]:
    """Both clouds without the ceiling (of the colours, what is near it) and without what lies far outside."""
    from ..cameras.paths import robust_bounds

    box = robust_bounds(semantic.means.double(), margin=0.02)

    def kept(cloud: Any) -> Any:
        inside = ((cloud.means >= box.low) & (cloud.means <= box.high)).all(dim=1)
        if OVERHEAD in names:
            labels = (semantic if cloud is semantic else kfgs.transfer_labels(semantic, cloud)).labels
            inside = inside & (labels != names.index(OVERHEAD))
        return cloud.select(inside)

    shown = kept(semantic)
    return shown, None if colors is None else shown if colors is semantic else kept(colors)


def read_walk(path: Walk, frames: int | None) -> Callable[[Any, list[kfgs.Camera]], list[kfgs.Camera]]:
    """Read the cameras of a file or folder, before anything else is read; the walk follows from the cloud and its cameras."""
    from .._check import check_whole
    from ..cameras import Orbit, orbit_cameras, path_cameras
    from ..scenes import load_cameras
    from ..scenes.load import is_scene
    from ..viz.linked import upwards

    own: list[kfgs.Camera] = []
    if frames is not None:
        check_whole("frames", frames, 2)
    if isinstance(path, Path):
        if not (path.is_file() and path.suffix == ".json") and not (path.is_dir() and is_scene(path)):
            raise ValueError(
                "path: expected orbit, cameras, a transforms.json (a name that ends in .json), or a folder with a COLMAP "
                f"model, got {path}; `--path cameras` flies along the cameras of the field"
            )
        own = load_cameras(path)
        own = own if frames is None else path_cameras(own, frames, size=own[0].size)

    def walk(cloud: Any, cameras: list[kfgs.Camera]) -> list[kfgs.Camera]:
        if own:  # the size of the scene, not that of the path, says what is too near to be drawn
            near = min((camera.near for camera in cameras), default=own[0].near)
            return [replace(camera, near=near) for camera in own]
        if path == "orbit":
            orbit = Orbit(frames=frames or FRAMES, elevation_degrees=45, zoom=1.5, cut=0.6)
            return orbit_cameras(cloud.means, orbit, up=upwards(cameras), origin=cloud.origin)
        if not cameras:
            advice = "or take an orbit"
            raise ValueError(f"scene: expected --scene for --path {path}, whose cameras it needs, got none; {advice}")
        cameras = [camera.with_origin(cloud.origin) for camera in cameras]
        size = (max(1, round(WIDTH * cameras[0].height / cameras[0].width)), WIDTH)
        return path_cameras(cameras, frames or FRAMES, every=max(1, round(len(cameras) / KEYS)), size=size)

    return walk


def _show(word: str, meaning: Any, semantic: Any, colors: Any) -> Any:
    """The function camera -> picture of a word of --show."""
    from ..viz import show_cloud
    from ..viz.films import show_selection

    under = None if colors is None else show_cloud(colors, color_by="rgb")
    if word == "photo" and under is not None:
        return under
    if word == "labels":
        return show_cloud(semantic, color_by="label")
    if word == "features" and semantic.features is not None:
        return show_cloud(semantic, color_by="feature")
    if word.startswith("query="):
        asked = meaning.ask(word.removeprefix("query="))
        say(f"{asked.words}: {len(asked.selection)} of {len(meaning.gaussians)} Gaussians, {asked.selection.summary}")
        return show_selection(meaning.gaussians, asked.selection.mask, under)
    raise ValueError(
        "show: expected photo (which needs --color), labels, features (of a field) or query=TEXT, with commas between, "
        f"got {word!r}; leave it out"
    )


def segment(
    field: Positional[Path],
    out: Path,
    *,
    split: Word = "test",
    path: Given[Walk] = None,
    frames: Given[int] = None,
    coco: Flag = False,
    classes: Classes,
) -> None:
    """Segment the views of a scene with a field; score them if there are label pictures. Or segment a camera path.

    Examples:
        kfgs segment run/field.kfgs --out segmented/
        kfgs segment run/field.kfgs --out segmented/ --split train --coco
        kfgs segment run/field.kfgs --out masks/ --path orbit --frames 40 --coco
        kfgs segment run/field.kfgs --out masks/ --path my_cameras.json --coco

    Args:
        field: The field that `kfgs fit` wrote (RUN/field.kfgs).
        out: Folder for label maps (predicted/ has class numbers, colored/ shows them in colours), pictures and scores.json. It
            holds the results; files of the same names are replaced.
        split: Which views: train, test, all, or another split that SCENE/split.json names.
        path: Segment the cameras of a path instead of the views of a split: orbit, cameras, or a file or folder with cameras
            of your own, all as in `kfgs render`.
        frames: Number of cameras of the path; by default 72, or your own cameras.
        coco: Write coco/annotations.json (COCO's run lengths, areas and boxes; one annotation for each class of each picture)
            and its pictures to coco/images: undistorted photographs, or with --path rendered colours.
    """
    from ..pipeline import true_labels
    from ..pipeline.segment import scored_labels, write_coco
    from ..viz import plot_iou

    check_output("out", out, "a folder")
    if path is not None:
        _segment_path(field, out, path, frames, coco, classes)
        return
    loaded = open_field("field", field)
    classes = classes.of(loaded)
    scene, label_set = classes.loaded, classes.load_classes(loaded)
    labels = scored_labels(scene.folder, label_set, say)
    truth = {} if labels is None else true_labels(scene, labels, split)
    seen = set(loaded.info.get("views", ())) & {scene.cameras[i].name for i in scene.views(split)}
    if seen:
        say(f"note: the field was trained on {len(seen)} of these views")
    maps = kfgs.segment_scene(loaded, scene, label_set, out, split=split, truth=truth, progress=True)
    written = [out / name for name in ("predicted", "colored", "sheets")]
    if coco:
        written.append(write_coco(out, maps, label_set.names, scene.image))
    if truth:
        scores = kfgs.score_scene(maps, truth, label_set)
        write_json(out / "scores.json", {"segmentation": scores.to_json(), "truth": str(labels), "field": str(field)})
        plot_iou(scores.iou, list(label_set.names), out / "iou.png")
        written += [out / "scores.json", out / "iou.png"]
        say(str(scores))
    else:
        say(f"note: no label pictures of split {split!r} to score against")
    wrote([place for place in written if place.exists()])


def _segment_path(field: Path, out: Path, path: Walk, frames: int | None, coco: bool, classes: Classes) -> None:
    """Segment the cameras of a path, and with --coco render the colours that they see."""
    from ..pipeline import segment_cameras
    from ..pipeline.segment import write_coco
    from ..viz import show_cloud

    walk_of = read_walk(path, frames)
    loaded = open_field("field", field)
    cameras = list(loaded.cameras) if classes.loaded is None else classes.loaded.cameras
    walk = walk_of(loaded.gaussians, cameras)
    label_set = classes.load_classes(loaded)
    maps = segment_cameras(loaded, walk, label_set, out, progress=True)
    written = [out / "predicted", out / "colored"]
    if coco:
        colors = open_colors(field, None, loaded)
        if colors is None:
            say("note: no colour splat is known, so the annotations have no pictures; train one with `kfgs color`")
        show = None if colors is None else show_cloud(colors, color_by="rgb")
        views = dict(zip(maps, walk, strict=True))
        picture = None if show is None else lambda name: show(views[name])
        written.append(write_coco(out, maps, label_set.names, picture))
    wrote(written)


def evaluate(
    field: Positional[Path],
    *,
    protocol: Word = "kfgs-pooled/1",
    truth: Given[Path] = None,
    labels: Given[Literal["own", "nearest", "paper"]] = None,
    out: Given[Path] = None,
    long: Flag = False,
    classes: Classes,
) -> None:
    """Score a result under a named protocol. docs/protocols.md lists the protocols, docs/datasets.md the layouts of truth.

    Examples:
        kfgs evaluate run
        kfgs evaluate run --scene scene/ --out scores.json --long
        kfgs evaluate run --protocol feature3dgs-teacher
        kfgs evaluate color.ply --scene scene/ --protocol kfgs-color

    Args:
        field: A run or field, or a folder of a teacher's maps; for kfgs-color a colour splat, or a run that has one.
        protocol: Its name, with or without version; a wrong name lists all. df3dgs scores the test views of the paper's split.
        truth: Folder or file of the ground truth, if it is not in the scene; the teacher's maps for feature3dgs-teacher.
        labels: Who says the class of a pixel: the field itself (own), Sec. 3.4 (paper), or the nearest text, as for others.
        out: JSON file of scores, rows, options, command and machine.
        long: Say how it was measured, and print every row.
    """
    from ..pipeline import evaluate as evaluate_result
    from ..pipeline import open_question

    if out is not None:
        check_output("out", out, "a file")
    loaded = open_field("field", field) if is_field(field) else None
    classes = classes if loaded is None else classes.of(loaded)
    if classes.scene is None:
        raise ValueError(f"scene: expected a scene folder, got none, and {field} is not a field with one; pass --scene")
    question = open_question(classes.scene, protocol, truth=truth)
    colors = getattr(question.protocol, "of_colors", False)
    result = field if colors or loaded is None else loaded
    words = None if colors else classes.load_classes(loaded)
    command = shlex.join(["kfgs", *sys.argv[1:]])
    report = evaluate_result(result, question, encode=words, labels=labels, command=command)
    if out is not None:  # before anything is printed, whose reader may have ended
        write_json(out, report.to_json())
    say(report.text if long else "\n".join([str(report), *(f"note: {note}" for note in report.notes)]))
    if out is not None:
        wrote([out])
