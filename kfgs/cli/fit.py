"""Commands that make fields and what they need: demo, sfm, fit, color; and batch, for many scenes."""

from __future__ import annotations

import os
import shlex
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

import kfgs

from .._files import real_path, write_json
from .files import say, wrote
from .options import Flag, Given, Positional, SceneFolder, Settings, Teacher, Views

PICTURES = 4  # held-out views that `kfgs color` draws
Workers = Annotated[str | None, tyro.conf.arg(metavar="NUMBER|ADDRESS", help_behavior_hint="")]
Method = Literal["uplift", "paper", "paper-full", "grown", "adc", "decouple"]


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

    wrote(run_demo.run(out, room=kfgs.ToyConfig(train_views=36, test_views=9), report=say, progress=True))
    look = ["view", str(out / "run" / "field.kfgs"), "--scene", str(out / "scene"), "--color", str(out / "color.ply")]
    say(f'6. Look. Type "chair" there, select, edit: kfgs {shlex.join(look)}')


def sfm(
    images: Positional[Path],
    out: Path,
    *,
    fps: float = 2.0,
    matching: Given[Literal["exhaustive", "sequential"]] = None,
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
        fps: Frames of each second of a video that are used; of 2, the sharpest of each half second.
        matching: sequential for the frames of a video, exhaustive for everything else; by default so.
        no_single_camera: The photographs were taken with several cameras, or with changes of zoom.
        min_registered: Share of the images that must be placed; fewer is an error.
        ignore_poses: Estimate poses also if the folder has some.
        replace: Replace a model that is in OUT/sparse/0 already; without it that is an error.
    """
    from ..scenes import SfmConfig, list_images
    from ..scenes.files import folder_masks
    from ..scenes.load import is_scene
    from ..scenes.sfm import link_images
    from ..scenes.video import VIDEO_SUFFIXES, extract_frames, is_video

    matching = matching or ("sequential" if is_video(images) else "exhaustive")
    config = SfmConfig(matching=matching, single_camera=not no_single_camera, min_registered=min_registered)
    if not is_video(images) and not ignore_poses and (is_scene(images) or images.suffix == ".json"):
        raise ValueError(
            f"images: expected photographs without poses, got {images} with some; `kfgs fit` and `kfgs color` take it as it is "
            "(and find its points, if it has none), or give --ignore-poses to estimate new ones"
        )
    if is_video(images):
        count = len(extract_frames(images, out / "images", fps=fps, progress=True))
        say(f"{images}: the {count} sharpest frames are in {out / 'images'}")
        images = out / "images"
    elif images.is_file():
        videos = f"a video ({', '.join(VIDEO_SUFFIXES)})"
        raise ValueError(f"images: expected a folder, or {videos}, got {images}; convert it to .mp4")
    for note in folder_masks(list_images(images), images)[1]:
        say(f"note: {note}")
    say(str(kfgs.run_sfm(images, out, config=config, replace=replace, progress=True)))
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
    settings: Settings,
    views: Views,
    teacher: Teacher,
) -> None:
    """Make a semantic field of a scene and its teacher's feature maps.

    The features are averaged onto Gaussians in 3-D and then compressed. The Gaussians are those of --splat. Without it they
    are trained on the pictures first; `kfgs color` with the same --out makes better ones, which are then used if it took more
    steps. A color.ply that is there already is not replaced.

    Examples:
        kfgs fit scene/ --out run/ --splat my.ply
        kfgs fit scene/ --out run/ --features maps/
        kfgs fit scene/ --out run/ --teacher mine:colors    # makes the maps, in OUT/features
        kfgs fit scene/ --out run/ --splat my.ply --set uplift.max_gaussians=none    # keeps every Gaussian of the splat
        kfgs fit scene/ --out run/ --method paper --set autoencoder.latent=12

    Args:
        out: Run folder; OUT/field.kfgs receives the field, OUT/report.html what was made. Running again continues.
        features: Folder of maps by `kfgs features` or another program; SCENE/features when not given.
        splat: Any splat of the scene, in its frame: the Gaussians to average onto. A file, or the output folder of 3DGS.
        method: uplift: average the features in 3-D, then compress. paper: compress each map, then train Gaussians on it
            (DF-3DGS), with its codebook and autoencoder and 2,000 steps; paper-full: with its 30,000; grown: with kfgs's own
            codebook; adc: without the autoencoder; decouple: on the raw features.
    """
    from ..pipeline.run_report import write_run_report
    from ..scenes.load import scene_root

    if splat is not None and method != "uplift":
        raise ValueError(f"splat: expected none with --method {method}, which trains its own Gaussians, got {splat}")
    made_by: Any = kfgs.Uplift(splat)
    if method != "uplift":
        paper: Any = {"paper-full": kfgs.Paper.paper, "grown": kfgs.Paper.grown}.get(method, kfgs.Paper)()
        left_out = {"decouple": ("codebook", "autoencoder"), "adc": ("autoencoder",)}.get(method, ())
        made_by = replace(paper, **dict.fromkeys(left_out))
    made_by = settings.of(made_by, f"--method {method}")
    as_taken = views.load(scene)
    loaded, split = as_taken.undistorted(), views.split
    maps = teacher.load() or kfgs.FeatureFolder(features or scene_root(scene) / "features").of(as_taken, split)
    field = kfgs.fit(loaded, maps, made_by, folder=out, split=split, report=say, progress=True)
    command = f"cd {shlex.quote(os.getcwd())}\n{shlex.join(['kfgs', *sys.argv[1:]])}"
    report = write_run_report(out, field, loaded, made_by, split=split, command=command)
    say(field.summary())
    wrote([out / "field.kfgs", *report])


def color(
    scene: SceneFolder,
    out: Path,
    *,
    preset: Literal["quick", "cpu", "paper"] = "cpu",
    settings: Settings,
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
    """
    from ..pipeline.run_report import draw_photos
    from ..viz.linked import evenly

    presets = {"quick": kfgs.ColorConfig.quick, "cpu": kfgs.ColorConfig.cpu, "paper": kfgs.ColorConfig}
    config = settings.of(presets[preset](), f"--preset {preset}")
    loaded, split = views.load(scene).undistorted(), views.split
    gaussians = kfgs.fit_color(loaded, out, config, split=split, report=say, progress=True)
    say(repr(gaussians))
    written = [out / "color.ply"]
    held_out = loaded.splits.get("test", [])
    if held_out and not set(held_out) & set(loaded.views(split)):
        scores = kfgs.score_views(gaussians, loaded, "test")
        write_json(out / "scores.json", {"color": scores.to_json()})
        say(str(scores))
        shown = [held_out[k] for k in evenly(len(held_out), PICTURES)]
        written += [*draw_photos(gaussians, loaded, shown, out / "views"), out / "scores.json"]
    else:
        say("note: no views are held out (split 'test', not trained on): nothing to score against")
    wrote(written)


def batch(
    scenes: Positional[Path],
    out: Path,
    *,
    text: Given[Path] = None,
    workers: Workers = None,
    blocks: Given[int] = None,
    splat: Given[Path] = None,
    teacher: Teacher,
) -> None:
    """Take many scenes through sfm, features, fit, segment and evaluate; or, with --blocks, one scene that is too large.

    SCENES is a text file with a scene in each line: a folder with a COLMAP model or a transforms.json, or a folder of photos
    whose cameras are found first. `name = scene` gives a run another name than its folder. Running again repeats nothing
    that is finished, and tries failed scenes again. Without --teacher each scene has its maps in features/; all workers must
    be able to read --weights. With --blocks, SCENES is the folder of one scene with a COLMAP model
    and feature maps: it is cut into blocks, and their fields are joined. --workers needs pip install 'kfgs[batch]'.

    Examples:
        kfgs batch scenes.txt --out runs/ --teacher lseg --weights demo_e200.ckpt --workers 2
        kfgs batch scenes.txt --out /shared/runs --workers slurm:gpu:16
        kfgs batch town/ --out city/ --blocks 16 --splat town.ply

    Args:
        scenes: The list of scenes (relative folders begin at that of the list), or with --blocks the scene.
        out: Folder of the runs: OUT/NAME receives field, segmented views, scores.json, state.json and log.txt. Of blocks:
            OUT/field.kfgs is the joined field.
        text: Text table of `kfgs features --words` for all scenes; each scene's classes.json and text.* when not given.
        workers: Processes on this machine, or a Dask scheduler (tcp://HOST:8786), or slurm:PARTITION:NUMBER. One scene after
            the other in this process when not given.
        blocks: Cut the scene SCENES into this many blocks. With fewer than about 300 views in each, a block fits into the
            memory of most machines.
        splat: With --blocks: Gaussians of the whole scene, a splat file; without it each block trains its own.
    """
    from ..batch import BatchOptions, fit_blocks, join_blocks, open_client, read_scenes, run_batch
    from ..teachers.load import check_teacher_name

    clients = nullcontext() if workers is None else open_client(workers)
    if blocks is not None:
        if (teacher, text) != (Teacher(), None):
            got = "--teacher, --weights or --text; leave these out"
            raise ValueError(f"blocks: expected a scene with features/, got {got}")
        with clients as client:
            fit_blocks(scenes, out, blocks, splat=splat, client=client, report=say)
        field = join_blocks(out)
        field.save(out / "field.kfgs")
        say(field.summary())
        wrote([out / "field.kfgs"])
        return
    entries = read_scenes(scenes)
    check_teacher_name(teacher.teacher, teacher.weights)
    local = int(workers) if workers is not None and workers.isdecimal() else 0
    threads = max(1, (os.cpu_count() or 1) // local) if local else 1
    options = BatchOptions(**vars(teacher), text=None if text is None else str(text), threads=threads)
    with clients as client:
        results = run_batch(entries, out, options, client=client, report=say)
    failed = [result.name for result in results if result.failure is not None]
    say(f"{len(results) - len(failed)} of {len(results)} scenes are finished; kfgs convert {out} has a line for each")
    if failed:
        some = ", ".join(failed[:3]) + (", ..." if len(failed) > 3 else "")
        raise ValueError(
            f"scenes: expected all {len(results)} to succeed, but {len(failed)} failed ({some}); see log.txt in their folders "
            f"of {out}, correct the cause, and give the same command again"
        )
