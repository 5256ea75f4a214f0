"""Commands of the semantic field: demo, sfm, fit, uplift, segment, label, info."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from .checks import check_alone, check_folder, open_field, open_splats
from .say import Method, Mode, Preset, field_classes, fit_config, load_classes, open_answering, say, wrote
from .teach import Level, check_discard, choose_teacher, scene_folder, stored_maps

# Heavy imports happen inside the commands, so that `kfgs --help` answers at once.

Rule = Literal["fused", "paper"]
SceneFolder = Annotated[Path, tyro.conf.Positional]


def demo(out: Path = Path("kfgs_demo"), seed: int = 0) -> None:
    """Make a furnished toy room, fit a semantic field to it, segment unseen views, label points: the whole main job.

    Args:
        out: folder for the scene, the run and its results; running again goes on where it stopped.
        seed: of the room and of the fit.
    """
    from ..pipeline import demo as run_demo
    from ..toy.room_folder import ToyConfig

    config = fit_config("cpu", "fuse", None, seed, None, None, "train")
    wrote(run_demo.run(out, config, room=ToyConfig(seed=seed), report=say, progress=True))
    say(f"next: kfgs view {out / 'run' / 'field'} --scene {out / 'scene'} --color {out / 'color.ply'}")


def sfm(
    images: Annotated[Path, tyro.conf.Positional],
    out: Path,
    matching: Literal["exhaustive", "sequential"] = "exhaustive",
    camera_model: str = "SIMPLE_RADIAL",
    min_registered: float = 0.9,
    seed: int = 0,
) -> None:
    """Find the cameras of a bare folder of images (structure from motion, pycolmap).

    Args:
        images: folder of images.
        out: scene folder to make: `out/sparse/0` receives the COLMAP model.
        matching: `sequential` for video frames in order, `exhaustive` for everything else.
        camera_model: COLMAP's name of the lens model, one camera for all images.
        min_registered: share of images that must be placed; fewer is an error.
        seed: of the geometric verification.
    """
    from ..scenes import SfmConfig, run_sfm

    config = SfmConfig(matching=matching, camera_model=camera_model, min_registered=min_registered, seed=seed)
    say(str(run_sfm(images, out, config=config, progress=True)))
    written = [out / "sparse" / "0"]
    beside = out / "images"
    if not os.path.lexists(beside):
        beside.symlink_to(images.resolve(), target_is_directory=True)  # so that `kfgs fit OUT` finds the pictures
        written.append(beside)
    elif beside.resolve() != images.resolve():
        say(f"note: {beside} is another folder; pass --images {images} to the other commands")
    wrote(written)


def fit(
    scene: SceneFolder,
    out: Path,
    features: Path | None = None,
    splat: Path | None = None,
    teacher: str | None = None,
    weights: str | None = None,
    fast: bool = False,
    size: tuple[int, ...] = (),
    discard_features: bool = False,
    level: Level | None = None,
    preset: Preset = "cpu",
    method: Method = "fuse",
    mode: Mode | None = None,
    split: str = "train",
    seed: int = 0,
    steps: int | None = None,
    max_gaussians: int | None = None,
    images: Path | None = None,
    undistorted_features: bool = False,
    device: str = "auto",
) -> None:
    """Make a semantic field of a posed scene and its teacher features.

    The features are averaged onto Gaussians in 3-D, and compressed after: those of --splat, or, without one, Gaussians that are
    trained on the pictures first (`kfgs color` in the same folder OUT makes better ones, which are then taken).

    Args:
        scene: folder with images and a COLMAP model or transforms.json.
        out: run folder; running again goes on where it stopped. `out/field` receives the field.
        features: folder of teacher maps as `kfgs features`, Feature 3DGS or LangSplat write them; SCENE/features when not
            given.
        splat: any splat file of the scene, in its frame: the Gaussians to fuse onto.
        teacher: run this teacher instead of reading maps (see `kfgs features`), and store none of them: it looks at most
            pictures once more, for samples.
        weights: of the teacher.
        fast: of the teacher, see `kfgs features`.
        size: of the teacher's maps, see `kfgs features`.
        discard_features: delete the dense maps when the stages made of them are done; later runs with the same options do not
            need them, but others (another --splat, say) do.
        level: which masks of LangSplat's maps are read: `default`, or those of subparts (s), parts (m) or wholes (l).
        preset: `cpu` (minutes on two cores) or `paper` (30,000 steps of training).
        method: `fuse` as above; `paper` compresses maps per pixel and trains Gaussians on them (DF-3DGS).
        mode: of the paper's method: `adc+sc` (codebook and autoencoder, 9 channels), `adc` (codebook), `decouple` (raw
            features). `adc+sc` when not given.
        split: views to learn from.
        seed: every random choice follows from it.
        steps: training steps, instead of the preset's.
        max_gaussians: most Gaussians of the field.
        images: folder of the pictures, if it is not SCENE/images.
        undistorted_features: the teacher saw undistorted pictures already, so its maps need no lens removed.
        device: where the field is trained: `auto` (a GPU if there is one), `cpu` or `cuda`.
    """
    from .._files import bytes_in_words
    from ..features import RecomputedMaps, discard_maps
    from ..pipeline import fit_scene, write_training_pictures
    from ..pipeline.train import check_scene
    from ..scenes import load_scene

    config = fit_config(preset, method, mode, seed, steps, max_gaussians, split)
    config = dataclasses.replace(config, undistorted_features=undistorted_features)
    check_folder("out", out)
    if method == "paper":
        check_alone("splat", splat, "beside --method paper, which trains its own Gaussians")
    elif splat is not None:
        check_alone("steps", steps, "beside --splat, which needs no training")
    as_taken = load_scene(scene, images=images)
    loaded = as_taken.undistorted()
    for note in loaded.notes:
        say(f"note: {note}")
    check_scene(loaded)  # before hours of features
    if teacher is not None:
        for name, given in (("features", features), ("level", level)):
            check_alone(name, given, "beside --teacher, whose maps are not stored")
        check_alone("discard-features", discard_features, "beside --teacher, which stores no dense maps")
        check_alone("undistorted-features", undistorted_features, "beside --teacher, which sees the pictures as taken")
        chosen = choose_teacher(teacher, weights, fast, size, device)
        maps: Any = RecomputedMaps(chosen, as_taken, split, out / "teacher")
    else:
        check_alone("weights", weights, "without --teacher, whose they are")
        check_alone("size", size or None, "without --teacher, whose option it is")
        check_alone("fast", fast, "without --teacher, whose option it is")
        maps = stored_maps(as_taken, loaded.views(split), features or scene_folder(scene) / "features", level)
        if discard_features:
            check_discard(maps, config)
    result = fit_scene(loaded, maps, out, config, splat=splat, report=say, progress=True, device=device)
    if teacher is not None:
        maps.clear()  # the samples; the stages made of them are found without
    say(result.field.summary())
    written = [result.field_path, *write_training_pictures(result)]
    if discard_features:
        freed = discard_maps(maps.path, maps.stems)
        say(
            f"{maps.path}: {bytes_in_words(freed)} of {len(maps)} dense maps deleted; what was made of them is in {out}"
        )
    wrote(written)


def segment(
    field: Annotated[Path, tyro.conf.Positional],
    out: Path,
    scene: Path | None = None,
    split: str = "test",
    classes: Path | None = None,
    text: Path | None = None,
    labels: Path | None = None,
    rule: Rule = "fused",
    pictures: int = 4,
    images: Path | None = None,
) -> None:
    """Segment the views of a scene with a field; score them where label pictures exist.

    Args:
        field: the folder that `kfgs fit` wrote (`RUN/field`).
        out: receives label maps, pictures and scores.json.
        scene: scene folder in the field's frame; the one that the field remembers when not given.
        split: views to segment.
        classes: JSON list of class names; SCENE/classes.json when not given.
        text: .npy of one embedding per class in the teacher's space, or a table of `kfgs text`; SCENE/text.npy or
            SCENE/text.safetensors when not given.
        labels: folder of true label pictures; SCENE/labels_scored or SCENE/labels when not given.
        rule: `fused`, what the field's Gaussians answer; `paper` decodes every pixel (Sec. 3.4), seconds a view.
        pictures: how many views get pictures.
        images: folder of the pictures, if it is not SCENE/images.
    """
    from .._files import read_json
    from ..fields import recall_scene
    from ..pipeline import score_scene, segment_scene, true_labels, write_report
    from ..scenes import load_scene
    from ..viz import plot_confusion, plot_iou

    field_ = open_field(field)
    scene = recall_scene(field_.info, field_.folder) if scene is None else scene
    loaded, label_set = load_scene(scene, images=images).undistorted(), load_classes(scene, classes, text)
    folder = labels or next((scene / name for name in ("labels_scored", "labels") if (scene / name).is_dir()), None)
    listed = scene / "classes.json"
    if labels is None and folder is not None and listed.is_file() and tuple(read_json(listed)) != label_set.names:
        say(f"note: not scored: {folder} counts the classes of {listed}, which are others; pass --classes {listed}")
        folder = None
    truth = {} if folder is None else true_labels(loaded, folder, split)
    if labels is not None and not truth:
        raise ValueError(
            f"labels: expected pictures <stem>.png of the views of split {split!r} in {labels}, found none"
        )
    seen = set(field_.info.get("views", ())) & {loaded.cameras[i].name for i in loaded.views(split)}
    if seen:
        say(f"note: the field was trained on {len(seen)} of these views")
    found = segment_scene(field_, loaded, label_set, out, split=split, rule=rule, pictures=pictures, progress=True)
    written = [out / name for name in ("predicted", "overlay", "features") if (out / name).is_dir()]
    if truth:
        scores = score_scene(found, truth, label_set)
        say(str(scores))
        write_report(out / "scores.json", segmentation=scores, truth=str(folder), field=str(field), rule=rule)
        plot_confusion(scores.confusion, list(label_set.names), out / "confusion.png", misses=scores.misses)
        plot_iou(scores.iou, list(label_set.names), out / "iou.png")
        written += [out / name for name in ("scores.json", "confusion.png", "iou.png")]
    else:
        say(f"note: no label pictures of split {split!r} to score against")
    wrote(written)


def uplift(
    scene: SceneFolder,
    splat: Annotated[Path, tyro.conf.Positional],
    out: Path,
    features: Path | None = None,
    max_gaussians: int | None = None,
    split: str = "train",
    level: Level | None = None,
    images: Path | None = None,
    undistorted_features: bool = False,
) -> None:
    """Give every Gaussian of a splat the teacher's features, without training: `kfgs fit` without merging.

    Args:
        scene: folder with images and a COLMAP model or transforms.json.
        splat: any splat file of the scene, or a field folder, in the scene's frame.
        out: the field folder to write.
        features: folder of teacher maps; SCENE/features when not given.
        max_gaussians: prune and merge to at most this many; every Gaussian is kept when not given.
        split: views to learn from.
        level: which masks of LangSplat's maps are read: `default`, `s`, `m` or `l`.
        images: folder of the pictures, if it is not SCENE/images.
        undistorted_features: the teacher saw undistorted pictures already, so its maps need no lens removed.
    """
    from ..fields import UpliftConfig
    from ..pipeline.fuse import uplift as uplift_scene
    from ..scenes import load_scene

    check_folder("out", out)
    as_taken = load_scene(scene, images=images)
    loaded = as_taken.undistorted()
    for note in loaded.notes:
        say(f"note: {note}")
    maps = stored_maps(as_taken, loaded.views(split), features or scene_folder(scene) / "features", level)
    cloud = open_field(splat).gaussians if (splat / "field.json").is_file() else open_splats("splat", splat).gaussians
    config = UpliftConfig(max_gaussians=max_gaussians)
    options: dict[str, Any] = {"split": split, "undistorted_features": undistorted_features, "folder": out}
    found = uplift_scene(loaded, maps, cloud, config, progress=True, report=say, **options)
    found.save(out)
    say(found.summary())
    wrote([out])


def label(
    field: Annotated[Path, tyro.conf.Positional],
    out: Path,
    classes: Path | None = None,
    text: Path | None = None,
    scene: Path | None = None,
    query: str | None = None,
    threshold: float | None = None,
    cloud: Path | None = None,
    distance: float | None = None,
    rule: Rule = "fused",
    images: Path | None = None,
) -> None:
    """Label the Gaussians of a field, and carry the labels to a cloud by distance.

    Args:
        field: the folder that `kfgs fit` wrote (`RUN/field`).
        out: receives gaussians.ply (and cloud.ply).
        classes: JSON list of class names; those that the field remembers when neither these nor --scene are given.
        text: .npy of one embedding per class; SCENE/text.npy when not given.
        scene: a scene folder that holds classes.json and text.npy.
        query: label only the Gaussians of this class, as `kfgs select` finds them.
        threshold: the paper's gamma; see `kfgs select`.
        cloud: PLY of points in the field's frame to carry the labels to. For a splat `kfgs attach` does better.
        distance: the paper's lambda: the distance within which a label is carried over, in world units; from the clouds'
            spacing when not given.
        rule: `fused`: what the training views show of a Gaussian decides; `paper`: its own latent (Sec. 3.4).
        images: folder of the scene's pictures, if it is not SCENE/images.
    """
    import torch

    from ..pipeline import label_cloud, read_cloud, save_labelled

    for name, value, other, needed in (
        ("threshold", threshold, "query", query),
        ("distance", distance, "cloud", cloud),
    ):
        if value is not None and needed is None:
            raise ValueError(f"{name}: expected --{other} beside it, got none; it would have no effect")
    loaded = open_answering(field, scene, images)
    label_set = field_classes(loaded, scene, classes, text)
    carried = None if cloud is None else read_cloud(cloud)
    targets = [out / "gaussians.ply"] + ([] if cloud is None else [out / "cloud.ply"])
    if cloud is not None and cloud.resolve() in {target.resolve() for target in targets}:
        raise ValueError(f"out: expected another folder than that of --cloud, got {out}; {cloud} would be overwritten")
    if query is None:
        labels, scores = loaded.classify(label_set, rule=rule)
        who = "what the views show of each Gaussian" if rule == "fused" else "each Gaussian's own latent (Sec. 3.4)"
        how = f"{who}; score = cosine"
    else:
        found = loaded.query(query, label_set, threshold, rule=rule)
        labels, scores = torch.where(found.mask, label_set.index(query), -1), found.scores
        how = f"{query}: {len(found)} Gaussians above gamma = {found.threshold:.4f} ({found.how})"
    gaussians = loaded.gaussians.replace(labels=labels)
    say(f"labelled by {how}")
    written = save_labelled(targets[0], gaussians, scores, label_set, rule=how)
    for i, name in enumerate(label_set.names):
        say(f"  {name:<16s} {int((labels == i).sum()):8d} Gaussians")
    if carried is not None:
        moved, paths = label_cloud(gaussians, carried, targets[1], label_set, distance=distance)
        say(str(moved))
        written += paths
    wrote(written)


def info(path: Annotated[Path, tyro.conf.Positional]) -> None:
    """Say what a field, a scene, or a PLY file holds.

    Args:
        path: a field folder, a run folder, a scene folder or a .ply file.
    """
    from ..pipeline import describe

    say(describe(path))
