"""Commands that make fields and what they need: demo, sfm, fit, color."""

from __future__ import annotations

import os
import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from .._files import real_path, write_json
from .options import Flag, Given, Matching, Positional, SceneFolder, Teacher, Views
from .output import say, wrote

# Heavy imports happen inside the commands, so that `kfgs --help` answers at once.

PICTURES = 4  # held-out views that `kfgs color` draws
Method = Literal["uplift", "paper", "paper-full", "adc", "decouple"]


def demo(out: Path = Path("kfgs_demo")) -> None:
    """See all of kfgs at work on a small room that it makes itself (about two minutes).

    It trains colours, makes a semantic field, segments unseen views, labels points, edits colours, and scores each against the
    exact truth. It says at each step what it does.

    Examples:
        kfgs demo
        kfgs demo --out somewhere/else

    Args:
        out: Folder for the scene, the run and its results; running again continues where it stopped.
    """
    from ..pipeline import demo as run_demo
    from ..toy.room_folder import ToyConfig

    room = ToyConfig(train_views=36, test_views=9)
    wrote(run_demo.run(out, room=room, report=say, progress=True))
    look = ["view", str(out / "run" / "field.kfgs"), "--scene", str(out / "scene"), "--color", str(out / "color.ply")]
    say(f'6. Look. Type "chair" there, select, edit: kfgs {shlex.join(look)}')


def sfm(
    images: Positional[Path],
    out: Path,
    *,
    fps: Given[float] = None,
    matching: Given[Matching] = None,
    no_single_camera: Flag = False,
    min_registered: float = 0.9,
    ignore_poses: Flag = False,
    replace: Flag = False,
) -> None:
    """Find the cameras of photographs or of a video (structure from motion, pycolmap).

    Of a video, the sharpest frames are written to OUT/images first. Nothing is found where a
    photograph is black in its mask, masks/NAME.png in the folder or next to it, or transparent.

    Examples:
        kfgs sfm photos/ --out scene/
        kfgs sfm video.mp4 --out scene/ --fps 2
        kfgs sfm frames/ --out scene/ --matching sequential    # frames of a video

    Args:
        images: Folder of photographs, or a video.
        out: Scene folder to make; OUT/sparse/0 receives the COLMAP model.
        fps: Frames of each second of a video that are used, 2 when not given: the sharpest of each half second.
        matching: sequential for the frames of a video, exhaustive for everything else; by default so.
        no_single_camera: The photographs were taken with several cameras, or with changes of zoom.
        min_registered: Share of the images that must be placed; fewer is an error.
        ignore_poses: Estimate poses also if the folder has some.
        replace: Replace a model that is in OUT/sparse/0 already; without it that is an error.
    """
    from ..scenes import SfmConfig, list_images, run_sfm
    from ..scenes.files import folder_masks
    from ..scenes.load import is_scene
    from ..scenes.sfm import link_images
    from ..scenes.video import VIDEO_SUFFIXES, extract_frames, is_video

    config = SfmConfig(
        matching=matching or ("sequential" if is_video(images) else "exhaustive"),
        single_camera=not no_single_camera,
        min_registered=min_registered,
    )
    if not is_video(images) and not ignore_poses and (is_scene(images) or images.suffix == ".json"):
        raise ValueError(
            f"images: expected photographs without poses, got {images} with some; `kfgs fit` and `kfgs color` take it as it is "
            "(and find its points, if it has none), or give --ignore-poses to estimate new ones"
        )
    if is_video(images):
        frames = extract_frames(images, out / "images", fps=fps or 2.0, progress=True)
        say(f"{images}: the {len(frames)} sharpest frames are in {out / 'images'}")
        images = out / "images"
    elif images.is_file():
        kinds = ", ".join(VIDEO_SUFFIXES)
        raise ValueError(f"images: expected a folder, or a video ({kinds}), got {images}; convert it to .mp4")
    for note in folder_masks(list_images(images), images)[1]:
        say(f"note: {note}")
    say(str(run_sfm(images, out, config=config, replace=replace, progress=True)))
    linked = link_images(images, out)
    if linked:
        say(f"{out / 'images'} is a link to {real_path(images)}: keep the photos there")
    elif real_path(out / "images") != real_path(images):
        say(f"note: other commands read the pictures of these names in {out / 'images'}; --images {images} names these")
    wrote([out / "sparse" / "0", *([out / "images"] if linked else [])])


def fit(
    scene: SceneFolder,
    out: Path,
    *,
    features: Given[Path] = None,
    splat: Given[Path] = None,
    method: Method = "uplift",
    steps: Given[int] = None,
    max_gaussians: Given[int] = None,
    views: Views,
    teacher: Teacher,
) -> None:
    """Make a semantic field of a scene and its teacher's feature maps.

    The features are averaged onto Gaussians in 3-D and then compressed. The Gaussians are those of --splat, or of the
    newest splat in the scene's folder (an output folder of 3DGS has one). Without both they are trained on the pictures
    first; `kfgs color` with the same --out makes better ones, which are then used if it took more steps. A
    color.ply that is there already is not replaced.

    Examples:
        kfgs fit scene/ --out run/ --splat my.ply
        kfgs fit scene/ --out run/ --features maps/
        kfgs fit scene/ --out run/ --teacher mine:colors    # makes the maps, in OUT/features
        kfgs fit scene/ --out run/ --splat my.ply --max-gaussians 0    # keeps every Gaussian of the splat
        kfgs fit scene/ --out run/ --method paper

    Args:
        out: Run folder; OUT/field.kfgs receives the field, OUT/report.html what was made. Running again continues.
        features: Folder of maps by `kfgs features` or another program; SCENE/features when not given.
        splat: Any splat file of the scene, in its frame: the Gaussians to average onto.
        method: uplift: average the features in 3-D, then compress. paper: compress each map, then train Gaussians on it
            (DF-3DGS) in minutes on two cores; paper-full: with the published 30,000 steps; adc: without the autoencoder;
            decouple: on the raw features.
        steps: Training steps; those of the method when not given.
        max_gaussians: At most this many Gaussians in the result, 0: all of the splat; the method's when not given.
    """
    from ..pipeline import fit as fit_field
    from ..pipeline.run_report import write_run_report
    from ..scenes import FeatureFolder
    from ..scenes.load import scene_root

    made_by = _method(method, splat, steps, max_gaussians)
    as_taken = views.load(scene)
    loaded, split = as_taken.undistorted(), views.split
    folder = features or scene_root(scene) / "features"
    network = teacher.load()
    if network is None and not folder.is_dir():
        raise ValueError(
            f"features: expected a folder of feature maps, got {folder}, which is none; name another, or make them with "
            "`kfgs features`"
        )
    maps = network or FeatureFolder(folder).of(as_taken, split)
    field = fit_field(loaded, maps, made_by, folder=out, split=split, report=say, progress=True)
    command = f"cd {shlex.quote(os.getcwd())}\n{shlex.join(['kfgs', *sys.argv[1:]])}"
    report = write_run_report(out, field, loaded, made_by, split=split, command=command)
    say(field.summary())
    wrote([out / "field.kfgs", *report])


def _method(method: Method, splat: Path | None, steps: int | None, most: int | None) -> Any:
    """The options of `pipeline.fit` for a method's name and the given numbers."""
    from ..fields import UpliftConfig
    from ..pipeline import Paper, Uplift

    if method == "uplift":
        made_by = Uplift(splat) if most is None else Uplift(splat, UpliftConfig(max_gaussians=most or None))
        return replace(made_by, color=_trained(made_by.color, steps))
    if splat is not None:
        raise ValueError(f"splat: expected none with --method {method}, which trains its own Gaussians, got {splat}")
    paper = _trained(Paper.paper() if method == "paper-full" else Paper(), steps, most)
    if method == "decouple":
        return replace(paper, codebook=None, autoencoder=None)
    return replace(paper, autoencoder=None) if method == "adc" else paper


def _trained(options: Any, steps: int | None, most: int | None = None) -> Any:
    """The options of `fit` or `fit_color` with another number of training steps and Gaussians."""
    training = options.training if steps is None else options.training.with_steps(steps)
    return replace(options, training=training.with_maximum(most or None))


def color(
    scene: SceneFolder,
    out: Path,
    *,
    preset: Literal["quick", "cpu", "paper"] = "cpu",
    steps: Given[int] = None,
    max_gaussians: Given[int] = None,
    views: Views,
) -> None:
    """Train a colour splat (3-D Gaussian Splatting) on a scene, and score it on the views held out.

    Examples:
        kfgs color scene/ --out run/
        kfgs color scene/ --out run/ --preset paper

    Args:
        out: Run folder; OUT/color.ply receives the splat. Running again continues where it stopped.
        preset: quick (a minute, for small scenes), cpu (minutes on two cores) or paper (30,000 steps, full size, degree 3:
            for a GPU).
        steps: Training steps; the preset's when not given.
        max_gaussians: At most this many Gaussians; the preset's when not given.
    """
    from ..evaluation.color import score_views
    from ..pipeline.color import ColorConfig, fit_color
    from ..pipeline.compare import draw_photos
    from ..viz.linked import evenly

    config = {"quick": ColorConfig.quick, "cpu": ColorConfig.cpu, "paper": ColorConfig}[preset]()
    loaded, split = views.load(scene).undistorted(), views.split
    gaussians = fit_color(loaded, out, _trained(config, steps, max_gaussians), split=split, report=say, progress=True)
    say(repr(gaussians))
    written = [out / "color.ply"]
    held_out = loaded.splits.get("test", [])
    if held_out and not set(held_out) & set(loaded.views(split)):
        scores = score_views(gaussians, loaded, "test")
        write_json(out / "scores.json", {"color": scores.to_json()})
        say(str(scores))
        shown = [held_out[k] for k in evenly(len(held_out), PICTURES)]
        written += [*draw_photos(gaussians, loaded, shown, out / "views"), out / "scores.json"]
    else:
        say("note: no views are held out (split 'test', not trained on): nothing to score against")
    wrote(written)
