"""Commands for splats: attach, edit, convert."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Literal

import kfgs

from .._files import atomic_folder, check_output
from .edits import Edits, parse_edits
from .files import SORTED, check_target, is_field, open_field, open_splats, say, say_lost, wrote
from .options import Classes, Flag, Given, Positional

PICTURES = 2  # views that `kfgs edit` shows
UNITS = {  # of the error of a tensor; those of all others are shares
    "gaussians.means": "world units a coordinate",
    "gaussians.quats": "degrees",
    "gaussians.scales": "of a scale, and as much of twice the error of a coordinate",
    **dict.fromkeys(("gaussians.opacities", "gaussians.features", "fused.latents"), ""),
}


def attach(
    field: Positional[Path],
    cloud: Positional[Path],
    out: Path,
    *,
    by: Given[Literal["views", "distance"]] = None,
    distance: Given[float] = None,
    splat_scene: Given[Path] = None,
    same_frame: Flag = False,
    classes: Classes,
) -> None:
    """Give every Gaussian of a splat, or every point of a cloud, the class that a semantic field has at its position.

    The frames of field and splat are compared first, and aligned if they differ.

    Examples:
        kfgs attach run/field.kfgs run/color.ply --out labelled.ply
        kfgs attach run/field.kfgs my.spz --out labelled.spz --splat-scene my_scene/
        kfgs attach run/field.kfgs my.ply --out labelled.ply --by distance --distance 0.05    # the paper's rule
        kfgs attach run/field.kfgs points.ply --out labelled.ply

    Args:
        field: The field that `kfgs fit` wrote (RUN/field.kfgs).
        cloud: A splat of the same scene in any format, by any program; or a PLY of points in the field's frame, which are
            labelled by distance and keep their other columns.
        out: The labelled splat to write, whose ending chooses the format; of points a .ply.
        by: views (the default): the field segments its training views, and each Gaussian takes the class of the pixels that
            it fills. distance: the nearest labelled Gaussian of the field within lambda decides, as in the paper (Sec. 3.4).
        distance: The paper's lambda: the distance within which a label is carried over, in the splat's world units; by
            default from the clouds' spacing.
        splat_scene: Scene folder of the splat's own cameras, if its frame differs: cameras of the same names align the two.
        same_frame: Do not compare the frames; they are the same.
    """
    from ..cameras.similarity import Similarity
    from ..pipeline.attach import is_cloud, label_cloud
    from ..pipeline.describe import count_lines
    from ..scenes import SceneError

    check_target("out", out)
    loaded = open_field("field", field)
    label_set = classes.load_classes(loaded)
    if not is_field(cloud) and is_cloud(cloud):
        moved, paths = label_cloud(loaded.label(label_set), cloud, out, distance=distance)
        say("\n".join([str(moved), *count_lines(moved.labels, label_set.names)]))
        wrote(paths)
        return
    splats = open_splats("cloud", cloud)
    scene = classes.loaded
    cameras = None if scene is None or loaded.cameras else scene.select("train").cameras
    frame: Any = Similarity.identity() if same_frame else None
    if splat_scene is not None:
        frame = kfgs.load_scene(splat_scene).undistorted().cameras
    try:
        attached = kfgs.attach(loaded, splats, label_set, cameras=cameras, frame=frame, distance=distance, by=by)
    except SceneError as error:
        raise SceneError(
            f"cloud: no frame found in which field and splat agree: {error} (--splat-scene gives the splat's cameras, "
            "--same-frame says that there is nothing to find)"
        ) from error
    written = kfgs.write_splats(attached.gaussians, out, facts=attached.facts)
    say("\n".join([*attached.notes, *count_lines(attached.labels, label_set.names)]))
    say_lost(written)
    wrote(written.paths)


def edit(
    splats: Positional[Path],
    out: Path,
    *,
    replay: Given[Path] = None,
    scene: Given[Path] = None,
    edits: Edits,
) -> None:
    """Edit a labelled splat by class. The edits are saved next to the result and can be replayed.

    The input does not change. For another order of edits run the command several times, or use --replay. In Python there are
    more: `kfgs.labels`.

    Examples:
        kfgs edit labelled.ply --out edited.ply --remove chair --recolor "plant:#c04040" --scene scene/
        kfgs edit labelled.ply --out edited.spz --move table:0.5,0,0
        kfgs edit other.ply --out again.ply --replay edited.ply.edits.json

    Args:
        splats: A splat with classes, for instance from `kfgs attach`.
        out: The edited splat; its ending chooses the format. The edits go to a file next to it (edited.ply.edits.json for
            edited.ply), and with --scene the views before and after to a picture (edited.ply.png).
        replay: Saved edits; they come first.
        scene: Scene folder in the same frame, for pictures of the views in which most changes.
    """
    from ..viz.compare import views_of_change, write_comparison

    check_target("out", out)
    saved = check_output("out", out.with_name(f"{out.name}.edits.json"), "a file")
    replayed = kfgs.EditList() if replay is None else kfgs.EditList.load(replay, anywhere=True)  # the user's own file
    by_class = any(rule.kind == "class" for change in replayed for rule in getattr(change, "where", ()))
    before = open_splats("splats", splats, named=replay is None or by_class)
    states = [before]
    for change in replayed:
        states.append(change.apply(states[-1]))
    asked = parse_edits(edits, states[-1].names)
    if not asked and not len(replayed):
        raise ValueError("edits: expected at least one, got none; give --remove, --recolor, --move or another")
    if scene is not None and before.sh is None:
        raise ValueError(f"scene: expected a splat with colours to show in it, got {before!r}; leave --scene out")
    cameras = [] if scene is None else kfgs.load_scene(scene).undistorted().cameras
    for change in asked:
        states.append(change.apply(states[-1]))
    *states, after = states
    shown = [cameras[i] for i in views_of_change(before, after, cameras, PICTURES, between=states[1:])]
    written = kfgs.write_splats(after, out)
    paths = [*written.paths, kfgs.EditList((*replayed, *asked)).save(saved)]
    if shown:
        paths.append(write_comparison(out.with_name(f"{out.name}.png"), before, after, shown))
    say(f"{len(before)} Gaussians before, {len(after)} after {len(states)} edit(s)")
    if len(after) == 0:
        say("note: nothing is left")
    say_lost(written)
    if shown:
        say("before and after from " + ", ".join(camera.name for camera in shown))
    elif cameras:
        say("note: no view of the scene shows a change")
    wrote(paths)


def convert(
    source: Positional[Path],
    target: Positional[Given[Path]] = None,
    *,
    precision: Literal["lossless", "fine", "small", "tiny"] = "small",
    plain: Flag = False,
    by_class: Flag = False,
) -> None:
    """Convert a splat file to another format, or pack a field; without TARGET, describe what a path holds.

    Classes are kept; losses of the new format are reported.

    Examples:
        kfgs convert run/    # describes a run, field, batch, scene, folder of maps, splat or cloud
        kfgs convert edited.ply edited.spz
        kfgs convert output/ scene.ply    # the newest splat of 3DGS, gsplat or nerfstudio
        kfgs convert labelled.ply objects/ --by-class
        kfgs convert run/ room.kfgs --precision fine    # a small file of a field
        kfgs convert run/ labelled.ply    # the field's own Gaussians in the colours of their classes

    Args:
        source: A .ply (3DGS, or SuperSplat's compressed), .splat, .ksplat, .spz, .sog, .glb or .gltf file; a checkpoint of
            gsplat (.pt) or nerfstudio (.ckpt); the output folder of 3DGS, gsplat or nerfstudio, whose newest splat is read; or
            a field.
        target: The file to write; its ending chooses the format: .ply, .compressed.ply, .splat, .spz, .sog, .glb, .gltf; of a
            field .kfgs or .ply.
        precision: Of a .kfgs file: lossless; fine (labels hardly change); small (0.6 MB for 50,000 Gaussians); tiny. The
            errors of each are printed, and kept in the file. All but lossless sort the Gaussians.
        plain: Write a .ply with exactly the properties of Inria's 3DGS, for importers that fail on others. The classes go to
            a file next to it, which kfgs finds again.
        by_class: TARGET is a folder that receives one plain .ply for each class, 05_chair.ply for class 5.
    """
    from ..batch.run import describe_batch
    from ..fields.store import read_description
    from ..pipeline.attach import save_labelled
    from ..pipeline.describe import describe

    if target is None:
        say(describe_batch(source) or describe(source))
    elif is_field(source) and target.suffix == ".ply":
        check_output("target", target, "a file")
        labelled = open_field("source", source).label()
        wrote(save_labelled(target, labelled, rule="what the views show of each Gaussian; score = cosine"))
    elif is_field(source) or target.suffix == ".kfgs":
        check_output("target", target, "a file")
        open_field("source", source).save(target, None if precision == "lossless" else precision)
        if precision != "lossless":
            about = read_description(target)
            for name, error in about["info"]["rounded"][-1]["errors"].items():
                unit = UNITS.get(name, "of a row's typical number")
                say(f"  {name:<32s} within {error:.3g} {unit}")
            say(f"{about['gaussians']:,} Gaussians in {target.stat().st_size / 2**20:.2f} MiB")
            say(f"note: {SORTED} field do not fit the new one")
        wrote([target])
    elif by_class:
        _convert_by_class(source, target)
    else:
        check_target("target", target)
        splats = open_splats("source", source)
        written = kfgs.write_splats(splats, target, plain=plain)
        say(repr(splats))
        say_lost(written)
        say(f"{len(splats):,} Gaussians in {target.stat().st_size / 2**20:.2f} MiB")
        wrote(written.paths)


def _convert_by_class(source: Path, folder: Path) -> None:
    """One plain PLY for each class of a splat. The class is in the name of its file, and in none next to it."""
    from ..labels.transfer import without_instances

    check_output("target", folder, "a folder")
    splats = open_splats("source", source, labelled=True)
    if len(splats) == 0:
        raise ValueError(f"source: expected Gaussians to divide by class, got none in {source}; name another splat")
    parts = {}
    for label, part in splats.by_class().items():  # numbers keep names apart that a file's name cannot hold
        word = re.sub(r"[^\w-]+", "_", splats.names[label] if 0 <= label < len(splats.names) else "").strip("_")[:80]
        plain = without_instances(part).replace(labels=None, scores=None)
        parts[f"{label:02d}{word and '_'}{word}.ply" if label >= 0 else "unlabelled.ply"] = plain
    if any((folder / name).is_file() and (folder / name).samefile(source) for name in parts):
        raise ValueError(f"target: expected another folder than that of {source}, which is read; give another name")
    with atomic_folder(folder) as new:
        written = [kfgs.write_splats(part, new / name, plain=True) for name, part in parts.items()]
    for name, part in parts.items():
        say(f"{name}: {len(part)} Gaussians")
    say_lost(*written)
    wrote([folder / path.name for file in written for path in file.paths])
