"""Commands of colour scenes: color, attach, edit, convert."""

from __future__ import annotations

import dataclasses
from itertools import accumulate
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from .._check import check_whole
from .checks import (
    check_alone,
    check_folder,
    check_parts,
    check_target,
    choose_views,
    edits_beside,
    open_splats,
)
from .edit_words import edits_from_words, inserted_files
from .say import field_classes, open_answering, say, say_lost, size_of, wrote

# Heavy imports happen inside the commands, so that `kfgs --help` answers at once.

ColorPreset = Literal["quick", "cpu", "paper"]
Method = Literal["nearest", "vote", "mahalanobis"]
TITLES = ("before", "after")
Several = tyro.conf.UseAppendAction[tuple[str, ...]]


def color(
    scene: Annotated[Path, tyro.conf.Positional],
    out: Path,
    preset: ColorPreset = "cpu",
    split: str = "train",
    seed: int = 0,
    steps: int | None = None,
    max_gaussians: int | None = None,
    pictures: int = 4,
    images: Path | None = None,
    device: str = "auto",
) -> None:
    """Fit a colour field (3-D Gaussian Splatting) to a posed scene, and score it on the views held out.

    Args:
        scene: folder with images and a COLMAP model or transforms.json.
        out: run folder; running again goes on where it stopped. `out/color.ply` receives the field.
        preset: `quick` (a minute, for small scenes), `cpu` (minutes on two cores) or `paper` (30,000 steps, full size,
            degree 3: for a GPU).
        split: views to learn from.
        seed: every random choice follows from it.
        steps: training steps, instead of the preset's.
        max_gaussians: stop densifying at this many Gaussians.
        pictures: how many of the views held out are drawn beside their photographs.
        images: folder of the pictures, if it is not SCENE/images.
        device: where the field is trained: `auto` (a GPU if there is one), `cpu` or `cuda`.
    """
    from ..evaluation.color import score_views
    from ..pipeline import write_report
    from ..pipeline.color import ColorConfig, fit_color
    from ..pipeline.compare import PhotoPictures
    from ..scenes import load_scene

    check_whole("pictures", pictures, 0)
    check_folder("out", out)
    config = {"quick": ColorConfig.quick, "cpu": ColorConfig.cpu, "paper": ColorConfig.paper}[preset]()
    fields = config.field if steps is None else config.field.with_steps(steps)
    if max_gaussians is not None:
        fields = dataclasses.replace(fields, max_gaussians=max_gaussians)
    config = dataclasses.replace(config, seed=seed, split=split, field=fields)
    loaded = load_scene(scene, images=images).undistorted()
    for note in loaded.notes:
        say(f"note: {note}")
    result = fit_color(loaded, out, config, report=say, progress=True, device=device)
    took = f"{result.seconds / 60:.1f} min" if result.seconds >= 60 else f"{result.seconds:.0f} s"
    say(f"{result.gaussians!r} in {took}")
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
    method: Method = "nearest",
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
        scene: a scene folder with classes.json and text.npy; those that the field remembers when not given.
        classes: JSON list of class names; SCENE/classes.json when not given.
        text: .npy of one embedding per class; SCENE/text.npy when not given.
        by: `views`: the field segments its training views and each Gaussian takes the class of the pixels that it fills;
            `distance`: the labelled Gaussians of the field within lambda (the distance within which a label is carried over)
            decide, as in the paper. `views` when not given.
        method: where distance decides: the `nearest` labelled Gaussian (as in the paper), a `vote` of those around, or their
            overlap (`mahalanobis`), which is the best of the three where the field's labels are noisy.
        distance: the paper's lambda in the splat's world units; from the clouds' spacing when not given.
        splat_scene: scene folder of the splat's own cameras, where its frame is another: cameras of the same names align
            the two. Without it the clouds themselves are compared, and aligned where they disagree.
        same_frame: take it that both share a frame, unchecked.
        images: folder of the scene's pictures, if it is not SCENE/images.
    """
    from ..cameras.similarity import Similarity
    from ..formats import write_splats
    from ..pipeline.attach import attach as attach_field
    from ..scenes import SceneError, load_scene

    check_target("out", out, splats)
    if scene is None:
        check_alone("images", images, "without --scene, whose pictures they are")
    if same_frame and splat_scene is not None:
        raise ValueError("same_frame: expected it alone, got --splat-scene too, whose cameras find the frame; drop one")
    loaded, cloud = open_answering(field, scene, images), open_splats("splats", splats)
    for name, asked in (("by", by == "views"), ("splat_scene", splat_scene is not None)):
        if asked and not loaded.cameras:
            raise ValueError(
                f"{name}: expected --scene beside it for a field that remembers no cameras, got none; pass --scene"
            )
    label_set = field_classes(loaded, scene, classes, text)
    same = Similarity.identity() if same_frame else None
    frame = same if splat_scene is None else load_scene(splat_scene).undistorted().cameras
    try:
        found = attach_field(
            loaded,
            cloud,
            label_set,
            frame=frame,
            distance=distance,
            by=by,
            method=method,
        )
    except SceneError as error:
        raise SceneError(
            f"splats: no frame found in which field and splat agree: {error} (--splat-scene gives the splat's cameras, "
            "--same-frame says that there is nothing to find)"
        ) from error
    for words in found.words:
        say(words)
    for i, name in enumerate(label_set.names):
        say(f"  {name:<16s} {int((found.labels == i).sum()):8d} Gaussians")
    if bool((found.labels < 0).any()):
        say(f"  {'(none)':<16s} {int((found.labels < 0).sum()):8d} Gaussians")
    written = write_splats(out, found.splats)
    say_lost(written)
    wrote(written.paths)


def edit(
    splats: Annotated[Path, tyro.conf.Positional],
    out: Path,
    recolor: Several = (),
    mode: Literal["tint", "hue"] = "tint",
    opacity: Several = (),
    scale: Several = (),
    rotate: Several = (),
    move: Several = (),
    duplicate: Several = (),
    remove: Several = (),
    extract: Several = (),
    insert: Several = (),
    replay: Path | None = None,
    scene: Path | None = None,
    views: Several = (),
    pictures: int = 2,
    images: Path | None = None,
) -> None:
    """Edit a labelled splat by class; the edits are saved beside it and can be replayed.

    Whatever their order on the line, edits are done in the order below, each on what those before left: --remove takes the
    copies of --duplicate too, and --insert is touched by no other. Another order: several calls, or --replay.

    A class stands for all that carries it; "chair/1" for the largest of its connected parts, "chair/2" for the next, as
    `kfgs select chair` lists them. Each edit counts the parts that those before left; --remove takes its own together.

    Args:
        splats: a splat with classes, as `kfgs attach` writes it.
        out: the edited splat; its ending chooses the format. The edits go to OUT.edits.json (as --replay reads them) and
            the views to OUT.png, with OUT less its ending.
        recolor: a class and a colour, "plant:#c04040"; this and the others may be given several times.
        mode: of --recolor: `tint` gives the colour itself and keeps the shading, `hue` keeps every lightness.
        opacity: a class and a factor in [0, 1], "lamp:0.3".
        scale: a class and a factor, "lamp:1.5", about the centre of what it moves: the class, or its part.
        rotate: a class, an axis of the world and degrees, "table:z,90", by the right hand about the same centre.
        move: a class and a translation in world units, "table:0.5,0,0".
        duplicate: a class and where its copy goes, seen from it, "chair:1,0,0".
        remove: a class, "chair", or one part of it, "chair/2".
        extract: keep only these classes, or parts of them.
        insert: a splat file to add, "lamp.ply", or that moved by a translation, "lamp.ply:1,0,0".
        replay: edits saved before, which come first; another file than OUT.edits.json.
        scene: scene folder in the splat's frame, whose cameras show the splat before and after.
        views: names of the views to show; when not given one for each edit in turn, then those in which most changes.
        pictures: how many views to show, where their names are not given.
        images: folder of the scene's pictures, if it is not SCENE/images.
    """
    from ..formats import write_splats
    from ..labels.edits import EditList
    from ..pipeline.compare import views_of_edits, write_comparison

    check_target("out", out, splats)
    saved = edits_beside(out, replay)
    check_whole("pictures", pictures, 0)
    if scene is None:
        check_alone("views", ", ".join(views) or None, "without --scene, whose views they are")
        check_alone("images", images, "without --scene, whose pictures they are")
    edits = EditList() if replay is None else EditList.load(replay, anywhere=True)  # the user's own file
    by_class = {"recolor": recolor, "opacity": opacity, "scale": scale, "rotate": rotate, "move": move}
    by_class |= {"duplicate": duplicate, "remove": remove, "extract": extract}
    replayed, asked = edits, tuple(edits_from_words(**by_class, mode=mode, insert=insert))
    for one in asked:
        edits = edits.then(one)
    if len(edits) == 0:
        raise ValueError("edits: expected at least one, got none; give --remove, --recolor, --move or another")
    check_target("out", out, *inserted_files(edits))
    before = open_splats("splats", splats, labelled=any(by_class.values()))
    check_parts(replayed.apply(before), asked)
    cameras = [] if scene is None else _cameras_to_show(before, scene, images, views)
    after = edits.apply(before)
    say(f"{len(before)} Gaussians before, {len(after)} after {len(edits)} edit(s)")
    if len(after) == 0:
        say("note: nothing is left")
    states = (cloud.gaussians for cloud in accumulate(edits, lambda cloud, one: one.apply(cloud), initial=before))
    shown = cameras if views or not cameras else [cameras[i] for i in views_of_edits(states, cameras, pictures)]
    written = write_splats(out, after)
    say_lost(written)
    paths = [*written.paths, edits.save(saved)]
    if cameras and pictures and not shown:
        say("note: no view of the scene shows a change")
    if shown:
        paths.append(write_comparison(out.with_suffix(".png"), before.gaussians, after.gaussians, shown, titles=TITLES))
        say("before and after from " + ", ".join(camera.name for camera in shown))
    wrote(paths)


def _cameras_to_show(splats: Any, scene: Path, images: Path | None, views: tuple[str, ...]) -> list[Any]:
    """The undistorted cameras of a scene, or of some of its views."""
    from ..scenes import load_scene

    if splats.gaussians.sh is None:
        raise ValueError(f"scene: expected a splat with colours to show in it, got {splats!r}; leave --scene out")
    loaded = load_scene(scene, images=images)
    return list((choose_views(loaded, views) if views else loaded).undistorted().cameras)


def convert(
    source: Annotated[Path, tyro.conf.Positional],
    target: Annotated[Path, tyro.conf.Positional],
) -> None:
    """Convert a splat file to another format; labels travel, and what the format cannot hold is named.

    Args:
        source: .ply (3DGS or SuperSplat's compressed), .splat, .ksplat, .spz, .sog, .glb or .gltf.
        target: the file to write; its ending chooses the format (.ply, .compressed.ply, .splat, .spz, .sog, .glb, .gltf).
    """
    from ..formats import write_splats

    check_target("target", target, source)
    splats = open_splats("source", source)
    say(repr(splats))
    written = write_splats(target, splats)
    say_lost(written)
    say(f"{size_of(source) / 2**10:,.1f} KiB -> {size_of(target) / 2**10:,.1f} KiB")
    wrote(written.paths)
