"""The command segment: label pictures of a field, for views of a scene or a camera path."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .._files import check_output, file_stem, read_json, write_json
from .files import check_alone, open_field
from .options import Classes, Flag, Given, GivenWalk, Positional, Rule, Walk
from .output import say, wrote
from .render import check_walk, walk_of
from .view import open_colors

if TYPE_CHECKING:
    from ..cameras import Camera

# Heavy imports happen inside the commands, so that `kfgs --help` answers at once.

PICTURES = 4  # views with a sheet


def segment(
    field: Positional[Path],
    out: Path,
    *,
    split: Given[str] = None,
    path: GivenWalk = None,
    frames: Given[int] = None,
    width: Given[int] = None,
    color: Given[Path] = None,
    coco: Flag = False,
    labels: Given[Path] = None,
    rule: Rule = "fused",
    pictures: Given[int] = None,
    classes: Classes,
) -> None:
    """Segment the views of a scene with a field; score them if there are label pictures. Or segment a camera path.

    Examples:
        kfgs segment run/field.kfgs --out segmented/
        kfgs segment run/field.kfgs --out segmented/ --scene scene/ --text words.safetensors --split train
        kfgs segment run/field.kfgs --out segmented/ --split train --coco
        kfgs segment run/field.kfgs --out masks/ --path orbit --frames 40 --coco
        kfgs segment run/field.kfgs --out masks/ --path my_cameras.json --coco

    Args:
        field: The folder that `kfgs fit` wrote (RUN/field.kfgs).
        out: Folder for label maps (predicted/ has class numbers, colored/ shows them in colours), pictures and scores.json. It
            holds the results; files of the same names are replaced.
        split: Which views: train, test, all, or another split that SCENE/split.json names; by default test.
        path: Segment the cameras of a path instead of the views of a split: orbit or cameras, as in `kfgs render`; or a
            file or folder with cameras of your own (transforms.json, COLMAP model, scene; without pictures, too): exactly
            these, or with --frames a smooth path through them.
        frames: Number of cameras of the path; by default 72, or your own cameras.
        width: Width of its pictures in pixels; by default 480, or that of your own cameras.
        color: Colour splat for the pictures of the path (with --coco); by default that of the run.
        coco: Write coco/annotations.json (COCO's run lengths, areas and boxes; one annotation for each class of each picture)
            and its pictures to coco/images: undistorted photographs, or with --path rendered colours.
        labels: Folder of true label pictures; SCENE/labels_scored or SCENE/labels when not given.
        rule: fused: the classes of the field's Gaussians; paper: decode every pixel (Sec. 3.4), seconds a view.
        pictures: How many views get a sheet (photograph, truth, field, features); by default 4.
    """
    from ..fields import recall_scene
    from ..pipeline import score_scene, segment_scene, true_labels, write_coco
    from ..pipeline.segment import picture_names
    from ..viz import plot_iou

    check_output("out", out, "a folder")
    if path is not None:
        check_alone("labels", labels, "with --path, of whose pictures nothing is known")
        for name, asked in (("split", split), ("pictures", pictures)):
            check_alone(name, asked, "with --path, which segments no views of the scene")
        walk = check_walk(path, frames, width)
        if isinstance(walk, list):
            picture_names(walk, "path")
        wrote(_segment_path(field, out, walk, frames, width, color, coco, rule, classes))
        return
    split, pictures = "test" if split is None else split, PICTURES if pictures is None else pictures
    alone: dict[str, object] = {"frames": frames, "width": width, "color": color}
    for name, given in alone.items():
        check_alone(name, given, "without --path, which it belongs to")
    loaded_field = open_field("field", field)
    scene = recall_scene(loaded_field.info) if classes.scene is None else classes.scene
    classes = dataclasses.replace(classes, scene=scene)
    loaded, label_set = classes.load_scene().undistorted(), classes.load_classes()
    folder = labels or next((scene / name for name in ("labels_scored", "labels") if (scene / name).is_dir()), None)
    listed = scene / "classes.json"
    if labels is None and folder is not None and listed.is_file() and tuple(read_json(listed)) != label_set.names:
        say(f"note: not scored: {folder} counts the classes of {listed}, which are others; pass --classes {listed}")
        folder = None
    truth = {} if folder is None else true_labels(loaded, folder, split)
    if labels is not None and not truth:
        raise ValueError(
            f"labels: expected pictures <stem>.png of the views of split {split!r} in {labels}, found none; "
            "name the folder that holds them"
        )
    seen = set(loaded_field.info.get("views", ())) & {loaded.cameras[i].name for i in loaded.views(split)}
    if seen:
        say(f"note: the field was trained on {len(seen)} of these views")
    found = segment_scene(
        loaded_field.paper if rule == "paper" else loaded_field,
        loaded,
        label_set,
        out,
        split=split,
        pictures=pictures,
        truth=truth,
        progress=True,
    )
    written = [out / name for name in ("predicted", "colored", "sheets")]
    if coco:
        views = {loaded.stem(i): i for i in loaded.views(split)}
        written.append(write_coco(out, found, label_set.names, lambda stem: loaded.image(views[stem])))
    if truth:
        scores = score_scene(found, truth, label_set)
        facts = {"truth": str(folder), "field": str(field), "rule": rule}
        write_json(out / "scores.json", {"segmentation": scores.to_json(), **facts})
        plot_iou(scores.iou, list(label_set.names), out / "iou.png")
        written += [out / name for name in ("scores.json", "iou.png")]
        say(str(scores))
    else:
        say(f"note: no label pictures of split {split!r} to score against")
    wrote([path for path in written if path.exists()])


def _segment_path(
    field: Path,
    out: Path,
    path: Walk | list[Camera],
    frames: int | None,
    width: int | None,
    color: Path | None,
    coco: bool,
    rule: Rule,
    classes: Classes,
) -> list[Path]:
    """Segment the cameras of a path, and with --coco render the colours that they see; name what was written."""
    from ..pipeline import segment_cameras, write_coco
    from ..viz import show_cloud

    classes.check_images()
    if not coco:
        check_alone("color", color, "without --coco, whose pictures it colours")
    loaded = classes.open_field("field", field)
    label_set = classes.of_field(loaded)
    cameras = list(loaded.cameras) if classes.scene is None else classes.load_scene().undistorted().cameras
    colors = open_colors(field, color, loaded) if coco else None
    walk: dict[str, Camera] = {
        file_stem(camera.name): camera for camera in walk_of(path, loaded.gaussians, cameras, frames, width)
    }
    found = segment_cameras(loaded, list(walk.values()), label_set, out, progress=True)
    written = [out / "predicted", out / "colored"]
    if coco:
        show = None if colors is None else show_cloud(colors, color_by="rgb")
        if show is None:
            say("note: no colour splat is known, so there are no pictures beside the annotations; --color names one")
        picture: Any = None if show is None else lambda name: show(walk[name])
        written.append(write_coco(out, found, label_set.names, picture))
    return written
