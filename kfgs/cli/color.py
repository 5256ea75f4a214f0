"""Commands of colour scenes: color, attach, select, edit, convert."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro

from .._check import check_whole
from .edit_words import edits_from_words
from .say import Preset, load_classes, say, size_of, training_cameras, wrote

# Heavy imports happen inside the commands, so that `kfgs --help` answers at once.

Several = tyro.conf.UseAppendAction[tuple[str, ...]]


def color(
    scene: Annotated[Path, tyro.conf.Positional],
    out: Path,
    preset: Preset = "cpu",
    split: str = "train",
    seed: int = 0,
    steps: int | None = None,
    max_gaussians: int | None = None,
    pictures: int = 4,
    images: Path | None = None,
) -> None:
    """Fit a colour field (3-D Gaussian Splatting) to a posed scene, and score it on the views held out.

    Args:
        scene: folder with images and a COLMAP model or transforms.json.
        out: run folder; running again goes on where it stopped. `out/color.ply` receives the field.
        preset: `cpu` (minutes on two cores) or `paper` (30,000 steps, full size, degree 3: for a GPU).
        split: views to learn from.
        seed: every random choice follows from it.
        steps: training steps, instead of the preset's.
        max_gaussians: stop densifying at this many Gaussians.
        pictures: how many of the views held out are drawn beside their photographs.
        images: folder of the pictures, if it is not SCENE/images.
    """
    from ..evaluation.color import score_views
    from ..pipeline import write_report
    from ..pipeline.color import ColorConfig, fit_color
    from ..pipeline.compare import PhotoPictures
    from ..scenes import load_scene

    check_whole("pictures", pictures, 0)
    config = ColorConfig.cpu() if preset == "cpu" else ColorConfig.paper()
    fields = config.field if steps is None else config.field.with_steps(steps)
    if max_gaussians is not None:
        fields = dataclasses.replace(fields, max_gaussians=max_gaussians)
    config = dataclasses.replace(config, seed=seed, split=split, field=fields)
    loaded = load_scene(scene, images=images).undistorted()
    for note in loaded.notes:
        say(f"note: {note}")
    result = fit_color(loaded, out, config, report=say, progress=True)
    say(f"{result.gaussians!r} in {result.seconds / 60:.1f} min")
    written = [result.path]
    if loaded.splits.get("test"):
        beside = PhotoPictures(out / "views", [loaded.stem(i) for i in loaded.views("test")], pictures)
        scores = score_views(result.gaussians, loaded, "test", show=beside)
        say(str(scores))
        write_report(out / "scores.json", color=scores)
        written += [*beside.written, out / "scores.json"]
    else:
        say("note: no views are held out (split 'test'): nothing to score against")
    wrote(written)


def attach(
    field: Annotated[Path, tyro.conf.Positional],
    splats: Annotated[Path, tyro.conf.Positional],
    out: Path,
    scene: Path | None = None,
    classes: Path | None = None,
    text: Path | None = None,
    by: Literal["views", "distance"] | None = None,
    distance: float | None = None,
    splat_scene: Path | None = None,
    same_frame: bool = False,
    images: Path | None = None,
) -> None:
    """Give every Gaussian of any splat file the class that a semantic field has at its place (Sec. 3.4).

    Args:
        field: the folder that `kfgs fit` wrote (`RUN/field`).
        splats: a splat of the same scene in any format, by any program.
        out: the labelled splat to write; its ending chooses the format.
        scene: the field's scene folder: classes.json, text.npy, and the cameras that vote.
        classes: JSON list of class names; SCENE/classes.json when not given.
        text: .npy of one embedding per class; SCENE/text.npy when not given.
        by: `views`: the field segments its training views and each Gaussian takes the class of the pixels that it fills;
            `distance`: the class of the nearest labelled Gaussian within lambda, as in the paper. `views` when a scene is
            given.
        distance: the paper's lambda in the splat's world units; from the clouds' spacing when not given.
        splat_scene: scene folder of the splat's own cameras, where its frame is another: cameras of the same names align
            the two. Without it the clouds themselves are compared, and aligned where they disagree.
        same_frame: take it that both share a frame, unchecked.
        images: folder of the scene's pictures, if it is not SCENE/images.
    """
    from ..cameras.similarity import Similarity
    from ..fields import SemanticField
    from ..formats import read_splats, write_splats
    from ..pipeline.attach import attach as attach_field
    from ..scenes import load_scene

    if out.resolve() == splats.resolve():
        raise ValueError(f"out: expected another file than the splat, got {out} twice; give another name")
    if same_frame and splat_scene is not None:
        raise ValueError("same_frame: expected it alone, got --splat-scene too, whose cameras find the frame; drop one")
    by = by or ("distance" if scene is None else "views")
    label_set, loaded, cloud = load_classes(scene, classes, text), SemanticField.load(field), read_splats(splats)
    cameras = None if scene is None else training_cameras(loaded, scene, images)
    others = None if splat_scene is None else load_scene(splat_scene).undistorted().cameras
    found = attach_field(
        loaded,
        cloud,
        label_set,
        cameras=cameras,
        splat_cameras=others,
        similarity=Similarity.identity() if same_frame else None,
        distance=distance,
        by=by,
    )
    for words in found.words:
        say(words)
    for i, name in enumerate(label_set.names):
        say(f"  {name:<16s} {int((found.labels == i).sum()):8d} Gaussians")
    written = write_splats(out, found.splats)
    for words in written.lost:
        say(f"note: {words}")
    wrote(written.paths)


def select(
    query: Annotated[str, tyro.conf.Positional],
    source: Annotated[Path, tyro.conf.Positional],
    out: Path | None = None,
    scene: Path | None = None,
    classes: Path | None = None,
    text: Path | None = None,
    threshold: float | None = None,
    negatives: bool = True,
    images: Path | None = None,
) -> None:
    """Which Gaussians are the chair? How many there are, where, how large, and the view that shows each best.

    Args:
        query: a class name, "chair".
        source: a field folder (`RUN/field`), asked by text; or a splat with classes, asked by label.
        out: folder for selection.json (with the indices) and selection.ply (the Gaussians), if wanted.
        scene: scene folder: classes.json, text.npy, and the cameras that score and show.
        classes: JSON list of class names; SCENE/classes.json when not given.
        text: .npy of one embedding per class; SCENE/text.npy when not given.
        threshold: of a field, the paper's gamma; from the scores' distribution when not given. Of a splat, the least score.
        negatives: tell the class from all others (relevancy) instead of by its cosine alone; of a field.
        images: folder of the scene's pictures, if it is not SCENE/images.
    """
    from .._files import write_json
    from ..fields import SemanticField
    from ..formats import SplatFile, read_splats, write_splats
    from ..labels import answers
    from ..pipeline import query_field
    from ..pipeline.apply import select_labelled
    from ..scenes import load_scene

    if (source / "field.json").is_file():
        label_set, field = load_classes(scene, classes, text), SemanticField.load(source)
        cameras = None if scene is None else training_cameras(field, scene, images)
        found = query_field(field, label_set, query, threshold, cameras=cameras, negatives=negatives)
        cloud = SplatFile(field.gaussians, {"score": found.scores.numpy()})
    else:
        cloud = read_splats(source)
        found = select_labelled(cloud, query, threshold)
        cameras = None if scene is None else load_scene(scene, images=images).undistorted().cameras
    say(f"{query}: {len(found)} of {len(cloud)} Gaussians, {found.words}")
    things = answers(cloud.gaussians, found, cameras)
    for thing in things:
        say(f"  {thing!r}")
    if out is not None:
        parts = [thing.to_json() for thing in things]
        facts = {"query": query, "threshold": found.threshold, "how": found.how, "count": len(found), "parts": parts}
        write_json(out / "selection.json", facts)
        wrote([out / "selection.json", *write_splats(out / "selection.ply", cloud.select(found.mask)).paths])


def edit(
    splats: Annotated[Path, tyro.conf.Positional],
    out: Path,
    remove: Several = (),
    recolor: Several = (),
    opacity: Several = (),
    move: Several = (),
    extract: Several = (),
    replay: Path | None = None,
    scene: Path | None = None,
    views: Several = (),
    pictures: int = 2,
    images: Path | None = None,
) -> None:
    """Edit a labelled splat by class: remove, recolour, fade, move, extract; the edits are saved and can be replayed.

    Args:
        splats: a splat with classes, as `kfgs attach` writes it.
        out: the edited splat; its ending chooses the format. The edits go to a .edits.json beside it.
        remove: a class to remove ("chair"); may be given several times, as all of these.
        recolor: a class and a colour, "plant:#c04040".
        opacity: a class and a factor in [0, 1], "lamp:0.3".
        move: a class and a translation in world units, "table:0.5,0,0".
        extract: keep only these classes.
        replay: edits saved before, which come first.
        scene: scene folder in the splat's frame, whose cameras show the splat before and after.
        views: names of the views to show; those in which most changes when not given.
        pictures: how many views to show.
        images: folder of the scene's pictures, if it is not SCENE/images.
    """
    from ..formats import read_splats, write_splats
    from ..labels.edits import EditList
    from ..pipeline.compare import views_of_change, write_comparison
    from ..scenes import load_scene

    if out.resolve() == splats.resolve():
        raise ValueError(f"out: expected another file than the splat, got {out} twice; edits never touch their source")
    if views and scene is None:
        raise ValueError("views: expected --scene beside it, whose views these are, got none")
    edits = EditList() if replay is None else EditList.load(replay)
    for one in edits_from_words(recolor=recolor, opacity=opacity, move=move, remove=remove, extract=extract):
        edits = edits.then(one)
    if len(edits) == 0:
        raise ValueError(
            "edits: expected at least one, got none; give --remove, --recolor, --opacity, --move, --extract"
        )
    before = read_splats(splats)
    cameras = []
    if scene is not None:
        loaded = load_scene(scene, images=images).undistorted()
        cameras = (loaded.select(views) if views else loaded).cameras
    after = edits.apply(before)
    say(f"{len(before)} Gaussians before, {len(after)} after {len(edits)} edit(s)")
    written = write_splats(out, after)
    for words in written.lost:
        say(f"note: {words}")
    paths = [*written.paths, edits.save(out.with_suffix(".edits.json"))]
    if cameras:
        clouds = before.gaussians, after.gaussians
        chosen = range(len(cameras)) if views else views_of_change(*clouds, cameras, pictures)
        shown = [cameras[i] for i in chosen]
        if shown:
            paths.append(write_comparison(out.with_suffix(".png"), *clouds, shown, titles=("before", "after")))
            say("before and after from " + ", ".join(camera.name for camera in shown))
    wrote(paths)


def convert(
    source: Annotated[Path, tyro.conf.Positional],
    target: Annotated[Path, tyro.conf.Positional],
) -> None:
    """Convert a splat file to another format; labels travel, and what the format cannot hold is named.

    Args:
        source: .ply (3DGS or SuperSplat's compressed), .splat, .ksplat, .spz, .sog, .glb or .gltf.
        target: the file to write; its ending chooses the format (.ply, .compressed.ply, .splat, .spz, .sog, .glb, .gltf).
    """
    from ..formats import read_splats, write_splats

    if source.resolve() == target.resolve():
        raise ValueError(f"target: expected another file than source, got {target} twice; give another name")
    splats = read_splats(source)
    say(repr(splats))
    written = write_splats(target, splats)
    for words in written.lost:
        say(f"note: {words}")
    say(f"{size_of(source) / 2**20:.2f} MiB -> {size_of(target) / 2**20:.2f} MiB")
    wrote(written.paths)
