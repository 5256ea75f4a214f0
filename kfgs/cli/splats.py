"""Commands for colour splats: attach, edit, convert."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any

from .._files import Names, check_output, real_path
from .edit_syntax import Edits, check_parts, classes_of, inserted_files, parse_edits
from .files import check_alone, check_target, open_splats
from .options import Classes, Flag, Given, GivenBy, Positional, SceneOption, Several
from .output import say, say_counts, say_lost, wrote

# Heavy imports happen inside the commands, so that `kfgs --help` answers at once.

TITLES = ("before", "after")


def attach(
    field: Positional[Path],
    splats: Positional[Path],
    out: Path,
    *,
    by: GivenBy = None,
    distance: Given[float] = None,
    splat_scene: Given[Path] = None,
    same_frame: Flag = False,
    classes: Classes,
) -> None:
    """Give every Gaussian of a splat file the class that a semantic field has at its position.

    The frames of field and splat are compared first, and aligned if they differ.

    Examples:
        kfgs attach run/field.kfgs run/color.ply --out labelled.ply
        kfgs attach run/field.kfgs my.spz --out labelled.spz --splat-scene my_scene/
        kfgs attach run/field.kfgs my.ply --out labelled.ply --by distance --distance 0.05    # the paper's rule

    Args:
        field: The folder that `kfgs fit` wrote (RUN/field.kfgs).
        splats: A splat of the same scene in any format, by any program.
        out: The labelled splat to write; its ending chooses the format.
        by: views (the default): the field segments its training views, and each Gaussian takes the class of the pixels that
            it fills. distance: the nearest labelled Gaussian of the field within lambda decides, as in the paper (Sec. 3.4).
        distance: The paper's lambda: the distance within which a label is carried over, in the splat's world units; by
            default from the clouds' spacing.
        splat_scene: Scene folder of the splat's own cameras, if its frame differs: cameras of the same names align the two.
            Without it the shapes of the clouds do.
        same_frame: Do not compare the frames; they are the same.
    """
    from .._check import check_range
    from ..cameras.similarity import Similarity
    from ..formats import write_splats
    from ..pipeline.attach import attach as attach_field
    from ..scenes import SceneError, load_scene

    check_target("out", out)
    classes.check_images()
    if distance is not None:
        check_range("distance", distance, 0, closed=(False, False))
    if same_frame and splat_scene is not None:
        raise ValueError("same_frame: expected it alone, got --splat-scene too, whose cameras find the frame; drop one")
    loaded, cloud = classes.open_field("field", field), open_splats("splats", splats)
    for name, asked in (("by", by == "views"), ("splat_scene", splat_scene is not None)):
        if asked and not loaded.cameras:
            raise ValueError(
                f"{name}: expected --scene with it for a field that remembers no cameras, got none; pass --scene"
            )
    label_set = classes.of_field(loaded)
    same = Similarity.identity() if same_frame else None
    frame = same if splat_scene is None else load_scene(splat_scene).undistorted().cameras
    try:
        found = attach_field(loaded, cloud, label_set, frame=frame, distance=distance, by=by)
    except SceneError as error:
        raise SceneError(
            f"splats: no frame found in which field and splat agree: {error} (--splat-scene gives the splat's cameras, "
            "--same-frame says that there is nothing to find)"
        ) from error
    written = write_splats(found.gaussians, out, facts=found.facts)
    for note in found.notes:
        say(note)
    say_counts(found.labels, label_set.names)
    say_lost(written)
    wrote(written.paths)


def edit(
    splats: Positional[Path],
    out: Path,
    *,
    replay: Given[Path] = None,
    views: Several = (),
    pictures: int = 2,
    edits: Edits,
    scene: SceneOption,
) -> None:
    """Edit a labelled splat by class. The edits are saved next to the result and can be replayed.

    The input does not change. For another order of edits run the command several times, or use --replay.

    Examples:
        kfgs edit labelled.ply --out edited.ply --remove chair --recolor "plant:#c04040" --scene scene/
        kfgs edit labelled.ply --out edited.spz --move table:0.5,0,0 --opacity lamp:0.3
        kfgs edit other.ply --out again.ply --replay edited.ply.edits.json

    Args:
        splats: A splat with classes, for instance from `kfgs attach`.
        out: The edited splat; its ending chooses the format. The edits go to a file next to it (edited.ply.edits.json for
            edited.ply), and with --scene the views before and after to a picture (edited.ply.png).
        replay: Saved edits; they come first.
        views: Name of a view to show (with --scene). By default one for each edit, then those in which most changes.
        pictures: How many views to show if none is named.
    """
    from .._check import check_whole
    from ..formats import write_splats
    from ..labels.edits import EditList
    from ..pipeline.compare import views_of_change, write_comparison

    check_target("out", out)
    saved = _edits_beside(out, replay)
    check_whole("pictures", pictures, 0)
    if scene.scene is None:
        check_alone("views", ", ".join(views) or None, "without --scene, whose views they are")
        scene.check_images()
    replayed = EditList() if replay is None else EditList.load(replay, anywhere=True)  # the user's own file
    asked = parse_edits(edits)
    if not asked and not len(replayed):
        raise ValueError("edits: expected at least one, got none; give --remove, --recolor, --move or another")
    check_target("out", out, *inserted_files([*replayed, *(edit for _, edit in asked)]))
    by_class = [*classes_of(replayed), *classes_of(edit for _, edit in asked)]
    named = any(isinstance(one, str) for one in by_class)
    before = open_splats("splats", splats, labelled=bool(by_class), named=named)
    start, listed = replayed.apply(before), replayed
    asked = parse_edits(edits, start.names)
    check_parts(start, [edit for _, edit in asked])
    for _, edit in asked:
        listed = listed.then(edit)
    cameras = [] if scene.scene is None else _cameras_to_show(before, scene, views)
    after = _apply(listed, before, [words for words, _ in asked])
    shown = cameras
    if cameras and not views:
        states = list(accumulate(listed, lambda cloud, edit: edit.apply(cloud), initial=before))[1:-1]
        shown = [cameras[i] for i in views_of_change(before, after, cameras, pictures, between=states)]
    written = write_splats(after, out)
    paths = [*written.paths, listed.save(saved)]
    if shown:
        picture = out.with_name(f"{out.name}.png")
        paths.append(write_comparison(picture, before, after, shown, titles=TITLES))
    say(f"{len(before)} Gaussians before, {len(after)} after {len(listed)} edit(s)")
    if len(after) == 0:
        say("note: nothing is left")
    say_lost(written)
    if cameras and pictures and not shown:
        say("note: no view of the scene shows a change")
    if shown:
        say("before and after from " + ", ".join(camera.name for camera in shown))
    wrote(paths)


def convert(
    source: Positional[Path],
    target: Positional[Path],
    *,
    plain: Flag = False,
    by_class: Flag = False,
) -> None:
    """Convert a splat file to another format. Classes are kept; losses of the new format are reported.

    Examples:
        kfgs convert edited.ply edited.spz
        kfgs convert scene.ksplat scene.ply
        kfgs convert output/ scene.ply    # the newest splat of 3DGS, gsplat or nerfstudio
        kfgs convert labelled.ply for_unity.ply --plain
        kfgs convert labelled.ply objects/ --by-class

    Args:
        source: A .ply (3DGS, or SuperSplat's compressed), .splat, .ksplat, .spz, .sog, .glb or .gltf file; a checkpoint of
            gsplat (.pt) or nerfstudio (.ckpt); or the output folder of 3DGS, gsplat or nerfstudio, whose newest splat is read.
        target: The file to write; its ending chooses the format: .ply, .compressed.ply, .splat, .spz, .sog, .glb, .gltf.
        plain: Write a .ply with exactly the properties of Inria's 3DGS, for importers that fail on others. The classes go to
            a file beside it, which kfgs finds again.
        by_class: TARGET is a folder that receives one plain .ply for each class, 05_chair.ply for class 5.
    """
    from ..formats import write_splats

    if by_class:
        check_alone("plain", plain, "with --by-class, whose files are plain")
        return _convert_by_class(source, target)
    check_target("target", target)
    splats = open_splats("source", source)
    shown = repr(splats)
    written = write_splats(splats, target, plain=plain)
    say(shown)
    say_lost(written)
    say(f"{_bytes_of(source) / 2**10:,.1f} KiB -> {_bytes_of(target) / 2**10:,.1f} KiB")
    wrote(written.paths)


def _convert_by_class(source: Path, folder: Path) -> None:
    """One plain PLY for each class of a splat. The class is in the name of its file, so there is nothing beside it."""
    from .._files import atomic_folder
    from ..formats import formats, write_splats

    endings = *(ending for one in formats().values() for ending in one.SUFFIXES), ".zip"
    if folder.name.lower().endswith(endings) and not folder.is_dir():
        raise ValueError(
            f"target: expected a folder for the files of the classes, got {folder}, the name of a file; leave its ending out"
        )
    check_output("target", folder, "a folder")
    splats = open_splats("source", source, labelled=True)
    if len(splats) == 0:
        raise ValueError(f"source: expected Gaussians to divide by class, got none in {source}; name another splat")
    parts = {_file_name(label, splats.names): part for label, part in splats.by_class().items()}
    for name in parts:
        if real_path(folder / name) == real_path(source):
            raise ValueError(
                f"target: expected another folder than that of {source}, got {folder}; it would be overwritten"
            )
    with atomic_folder(folder) as new:
        for name, part in parts.items():
            written = write_splats(part.replace(labels=None, scores=None), new / name, plain=True)
    for name, part in parts.items():
        say(f"{name}: {len(part)} Gaussians")
    say_lost(written)
    wrote([folder / name for name in parts])


def _file_name(label: int, classes: Sequence[str]) -> str:
    """`05_chair.ply` for class 5; the number keeps names apart that differ only in what a file's name cannot hold."""
    if label < 0:
        return "unlabelled.ply"
    word = re.sub(r"[^\w-]+", "_", classes[label]).strip("_")[:80] if label < len(classes) else ""
    return f"{label:02d}_{word}.ply" if word else f"{label:02d}.ply"


def _apply(edits: Any, splats: Any, asked: list[str]) -> Any:
    """Apply edits, of which the last ones come from options: the error of one quotes the option's words."""
    from ..labels.edits.edit_list import EditError

    try:
        return edits.apply(splats)
    except EditError as error:
        option = error.index - (len(edits) - len(asked))
        if option < 0:
            raise
        raise ValueError(f"{asked[option]}: {error.why}") from error


def _edits_beside(out: Path, replay: Path | None) -> Path:
    """The file for the edits of a splat file; an error if it is the file to replay, another file, or cannot be written."""
    from ..labels.edits.edit_list import edits_path

    saved = edits_path(out)
    check_output("out", saved, "a file")
    if replay is not None and real_path(replay) == real_path(saved):
        raise ValueError(
            f"replay: expected another file than {saved}, where the edits behind {out} are saved, got the same; give --out "
            "another name"
        )
    return saved


def _cameras_to_show(splats: Any, scene: SceneOption, views: Sequence[str]) -> list[Any]:
    """The undistorted cameras of a scene, or of some of its views."""
    if splats.sh is None:
        raise ValueError(f"scene: expected a splat with colours to show in it, got {splats!r}; leave --scene out")
    loaded = scene.load_scene()
    return list((_choose_views(loaded, views) if views else loaded).undistorted().cameras)


def _choose_views(scene: Any, names: Sequence[str]) -> Any:
    """The scene with the named views only; a ValueError if a name is unknown, or one view is named twice."""
    known, seen = Names((camera.name for camera in scene.cameras), bare=True), set[str]()
    for name in names:
        view = known.find(name)
        if view is None:
            raise ValueError(
                f"views: expected names of the scene's {len(scene)} views, got {name!r}; {known.advice(name)}"
            )
        if view in seen:
            raise ValueError(f"views: expected each view once, got {view!r} twice; name it once")
        seen.add(view)
    return scene.select(names)


def _bytes_of(path: Path) -> int:
    """Bytes of a file, or of all files in a folder."""
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    return sum(file.stat().st_size for file in files)
