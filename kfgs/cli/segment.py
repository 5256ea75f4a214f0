"""The command segment: label pictures of a field, for views of a scene or a camera path."""

from __future__ import annotations

from pathlib import Path

from .._files import check_output, write_json
from .files import open_field
from .options import Classes, Flag, Given, Positional, Walk, Word
from .output import say, wrote
from .render import read_walk, walk_of
from .view import open_colors

# Heavy imports happen inside the commands, so that `kfgs --help` answers at once.


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
        path: Segment the cameras of a path instead of the views of a split: orbit or cameras, as in `kfgs render`; or a
            file or folder with cameras of your own (transforms.json, COLMAP model, scene; without pictures, too): exactly
            these, or with --frames a smooth path through them.
        frames: Number of cameras of the path; by default 72, or your own cameras.
        coco: Write coco/annotations.json (COCO's run lengths, areas and boxes; one annotation for each class of each picture)
            and its pictures to coco/images: undistorted photographs, or with --path rendered colours.
    """
    from ..pipeline import score_scene, segment_scene, true_labels
    from ..pipeline.segment import scored_labels, write_coco
    from ..viz import plot_iou

    check_output("out", out, "a folder")
    if path is not None:
        _segment_path(field, out, path, frames, coco, classes)
        return
    loaded_field = open_field("field", field)
    classes = classes.of(loaded_field)
    scene, label_set = classes.loaded, classes.load_classes(loaded_field)
    assert classes.scene is not None
    labels = scored_labels(classes.scene, label_set, say)
    truth = {} if labels is None else true_labels(scene, labels, split)
    views = {scene.stem(i): i for i in scene.views(split)}
    seen = set(loaded_field.info.get("views", ())) & {scene.cameras[i].name for i in views.values()}
    if seen:
        say(f"note: the field was trained on {len(seen)} of these views")
    maps = segment_scene(loaded_field, scene, label_set, out, split=split, truth=truth, progress=True)
    written = [out / name for name in ("predicted", "colored", "sheets")]
    if coco:
        written.append(write_coco(out, maps, label_set.names, lambda stem: scene.image(views[stem])))
    if truth:
        scores = score_scene(maps, truth, label_set)
        write_json(out / "scores.json", {"segmentation": scores.to_json(), "truth": str(labels), "field": str(field)})
        plot_iou(scores.iou, list(label_set.names), out / "iou.png")
        written += [out / "scores.json", out / "iou.png"]
        say(str(scores))
    else:
        say(f"note: no label pictures of split {split!r} to score against")
    wrote([place for place in written if place.exists()])


def _segment_path(field: Path, out: Path, path: Walk, frames: int | None, coco: bool, classes: Classes) -> None:
    """Segment the cameras of a path, and with --coco render the colours that they see."""
    from ..fields.store import find_field
    from ..pipeline import segment_cameras
    from ..pipeline.segment import write_coco
    from ..viz import show_cloud

    own = read_walk(path, frames)
    loaded = open_field("field", field)
    cameras = list(loaded.cameras) if classes.loaded is None else classes.loaded.cameras
    walk = walk_of(own, loaded.gaussians, cameras, frames)
    label_set = classes.load_classes(loaded)
    maps = segment_cameras(loaded, walk, label_set, out, progress=True)
    written = [out / "predicted", out / "colored"]
    if coco:
        colors = open_colors(find_field(field), None, loaded)
        if colors is None:
            say("note: no colour splat is known, so the annotations have no pictures; train one with `kfgs color`")
        show = None if colors is None else show_cloud(colors, color_by="rgb")
        views = dict(zip(maps, walk, strict=True))
        picture = None if show is None else lambda name: show(views[name])
        written.append(write_coco(out, maps, label_set.names, picture))
    wrote(written)
