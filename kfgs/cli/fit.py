"""Commands that make fields and what they need: demo, sfm, fit, color."""

from __future__ import annotations

import dataclasses
import os
import shlex
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Literal

from .._files import check_output, real_path, write_json
from .features import choose_teacher, stored_maps
from .files import check_alone
from .options import (
    CameraSearch,
    FieldMethod,
    Flag,
    Given,
    Maps,
    MapTeacher,
    Positional,
    SceneFolder,
    Training,
    Views,
    fit_method,
    trained,
)
from .output import called, say, wrote

# Heavy imports happen inside the commands, so that `kfgs --help` answers at once.


def demo(out: Path = Path("kfgs_demo"), seed: int = 0) -> None:
    """See all of kfgs at work on a small room that it makes itself (about two minutes).

    It trains colours, makes a semantic field, segments unseen views, labels points, edits colours, and scores each against the
    exact truth. It says at each step what it does. In a terminal with a display, it ends by opening `kfgs view`.

    Examples:
        kfgs demo
        kfgs demo --out somewhere/else

    Args:
        out: Folder for the scene, the run and its results; running again continues where it stopped.
        seed: Every random choice follows from it.
    """
    from ..pipeline import demo as run_demo
    from ..toy.room_folder import ToyConfig
    from ..viz.plotter import has_display

    check_output("out", out, "a folder")
    room = ToyConfig(train_views=36, test_views=9, seed=seed)
    wrote(run_demo.run(out, seed=seed, room=room, report=say, progress=True))
    look = ["view", str(out / "run" / "field.kfgs"), "--scene", str(out / "scene"), "--color", str(out / "color.ply")]
    say(f'6. Look. Type "chair" there, select, edit: kfgs {shlex.join(look)}')
    if has_display() and sys.stdin.isatty() and sys.stdout.isatty():
        with suppress(KeyboardInterrupt):  # the viewer ends by it
            subprocess.run([sys.executable, "-m", "kfgs", *look], check=False)


def sfm(
    images: Positional[Path],
    out: Path,
    fps: Given[float] = None,
    seed: int = 0,
    replace: Flag = False,
    *,
    search: CameraSearch,
) -> None:
    """Find the cameras of photographs or of a video (structure from motion, pycolmap).

    Of a video, the sharpest frames are written to OUT/images first. HEIC photographs are written there as JPEG. A folder that
    has poses already (transforms.json, ScanNet, Polycam, ...) keeps them: only its points are found. Nothing is found where a
    photograph is black in its mask, masks/NAME.png in the folder or beside it, or transparent.

    Examples:
        kfgs sfm photos/ --out scene/
        kfgs sfm video.mp4 --out scene/ --fps 2
        kfgs sfm frames/ --out scene/ --matching sequential    # frames of a video
        kfgs sfm capture/ --out scene/                         # capture/ has poses: they are kept

    Args:
        images: Folder of photographs, a video, or a folder with poses.
        out: Scene folder to make; OUT/sparse/0 receives the COLMAP model.
        fps: Frames of each second of a video that are used, 2 when not given: the sharpest of each half second.
        seed: Every random choice follows from it.
        replace: Replace a model that is in OUT/sparse/0 already; without it that is an error.
    """
    from ..scenes import (
        SfmConfig,
        is_scene,
        link_images,
        list_images,
        load_scene,
        run_sfm,
        write_known_poses,
    )
    from ..scenes.masks import folder_masks
    from ..scenes.pictures import is_video

    check_output("out", out, "a folder")
    video = is_video(images)
    if not video:
        check_alone("fps", fps, "with photographs, which are all used")
    config = SfmConfig(
        matching=search.matching or ("sequential" if video else "exhaustive"),
        camera_model=search.camera_model,
        single_camera=not search.no_single_camera,
        min_registered=search.min_registered,
        seed=seed,
    )
    if not video and not search.ignore_poses and (is_scene(images) or images.suffix == ".json"):
        for name, given in (("matching", search.matching), ("no_single_camera", search.no_single_camera)):
            check_alone(
                name, given, "with a folder that has poses, whose neighbours are compared (or give --ignore-poses)"
            )
        scene = load_scene(images, split="all")
        say(
            f"{images}: has the poses of {len(scene)} pictures: they are kept, and points are found (not so: --ignore-poses)"
        )
        say(str(write_known_poses(scene, out, config=config, replace=replace, progress=True)))
        wrote([out / "sparse" / "0", out / "images"])
        return
    images = _plain_pictures(images, out, fps)
    for note in folder_masks(list_images(images), images)[1]:
        say(f"note: {note}")
    say(str(run_sfm(images, out, config=config, replace=replace, progress=True)))
    written = [out / "sparse" / "0"]
    beside = out / "images"
    if link_images(images, out):
        say(f"{beside} is a link to {real_path(images)}: keep the photos there")
        written.append(beside)
    elif real_path(beside) != real_path(images):
        say(f"note: other commands read the pictures of these names in {beside}; --images {images} names these")
    wrote(written)


def _plain_pictures(images: Path, out: Path, fps: float | None) -> Path:
    """A folder of pictures that pycolmap reads: of a video its frames, of HEIC photographs JPEG files, both in OUT/images."""
    from ..scenes import convert_heic, extract_frames
    from ..scenes.pictures import VIDEO_SUFFIXES, has_heic, is_video

    if is_video(images):
        frames = extract_frames(images, out / "images", fps=2.0 if fps is None else fps, progress=True)
        say(f"{images}: the {len(frames)} sharpest frames are in {out / 'images'}")
    elif has_heic(images):
        found = convert_heic(images, out / "images", progress=True)
        masks = next((place / "masks" for place in (images, images.parent) if (place / "masks").is_dir()), None)
        if masks is not None and not os.path.lexists(out / "masks"):
            (out / "masks").symlink_to(real_path(masks), target_is_directory=True)
        say(f"{images}: HEIC photographs are JPEG files in {out / 'images'}, {len(found)} pictures in all")
    elif images.is_file():
        raise ValueError(
            f"images: expected a folder, or a video ({', '.join(VIDEO_SUFFIXES)}), got {images}; convert it to .mp4"
        )
    else:
        return images
    return out / "images"


def fit(
    scene: SceneFolder,
    out: Path,
    *,
    splat: Given[Path] = None,
    method: FieldMethod,
    views: Views,
    maps: Maps,
    teacher: MapTeacher,
    training: Training,
) -> None:
    """Make a semantic field of a scene and its teacher features.

    The features are averaged onto Gaussians in 3-D and then compressed. The Gaussians are those of --splat, or of the
    newest splat in the scene's folder (an output folder of 3DGS has one). Without both they are trained on the pictures
    first; `kfgs color` with the same --out makes better ones, which are then used if it took more steps. A
    color.ply that is there already is not replaced.

    Examples:
        kfgs fit scene/ --out run/ --splat my.ply
        kfgs fit scene/ --out run/ --features maps/
        kfgs fit scene/ --out run/ --teacher lseg --weights demo_e200.ckpt    # maps in run/features
        kfgs fit scene/ --out run/ --splat my.ply --max-gaussians 0            # keeps every Gaussian of the splat
        kfgs fit scene/ --out run/ --method paper --preset paper

    Args:
        out: Run folder; OUT/field.kfgs receives the field, OUT/report.html what was made. Running again continues.
        splat: Any splat file of the scene, in its frame: the Gaussians to average onto.
    """
    from ..pipeline import fit as fit_field
    from ..pipeline import write_run_report
    from ..pipeline.train import check_scene

    made_by = fit_method(method, splat, training=training)
    check_output("out", out, "a folder")
    if splat is not None:
        check_alone("steps", training.steps, "with --splat, which needs no training")
    as_taken = views.load(scene)
    if splat is None and as_taken.splat is not None and method.method != "paper":
        check_alone(
            "steps", training.steps, f"with a scene that has its splat ({as_taken.splat}), which needs no training"
        )
    loaded = as_taken.undistorted()
    chosen = loaded.views(views.split)
    check_scene(loaded, chosen)  # before hours of features
    if teacher.teacher is not None:
        check_alone("features", maps.features, "with --teacher, whose maps are stored in OUT/features")
        check_alone(
            "undistorted_features", maps.undistorted_features, "with --teacher, which sees the original pictures"
        )
        source = choose_teacher(teacher.teacher, teacher.weights, teacher.fast, teacher.size, training.device)
    else:
        teacher.check_weights()
        check_alone("size", teacher.size or None, "without --teacher, whose option it is")
        check_alone("fast", teacher.fast, "without --teacher, whose option it is")
        source = stored_maps(as_taken, chosen, maps.folder(scene))
    field = fit_field(
        loaded,
        source,
        made_by,
        folder=out,
        split=views.split,
        seed=training.seed,
        device=training.device,
        undistorted_features=maps.undistorted_features,
        report=say,
        progress=True,
    )
    command = f"cd {shlex.quote(os.getcwd())}\n{shlex.join(called)}"
    report = write_run_report(out, field, loaded, made_by, split=views.split, command=command)
    say(field.summary())
    wrote([out / "field.kfgs", *report])


def color(
    scene: SceneFolder,
    out: Path,
    *,
    preset: Literal["quick", "cpu", "paper"] = "cpu",
    pictures: int = 4,
    views: Views,
    training: Training,
) -> None:
    """Train a colour splat (3-D Gaussian Splatting) on a scene, and score it on the views held out.

    Examples:
        kfgs color scene/ --out run/
        kfgs color scene/ --out run/ --preset paper --device cuda

    Args:
        out: Run folder; OUT/color.ply receives the splat. Running again continues where it stopped.
        preset: quick (a minute, for small scenes), cpu (minutes on two cores) or paper (30,000 steps, full size, degree 3:
            for a GPU).
        pictures: Number of held-out views to draw next to their photographs.
    """
    from .._check import check_whole
    from ..evaluation.color import score_views
    from ..pipeline.color import ColorConfig, fit_color
    from ..pipeline.compare import PhotoPictures

    check_whole("pictures", pictures, 0)
    check_output("out", out, "a folder")
    config = {"quick": ColorConfig.quick, "cpu": ColorConfig.cpu, "paper": ColorConfig.paper}[preset]()
    config = dataclasses.replace(config, training=trained(config.training, training))
    loaded = views.load(scene).undistorted()
    held_out = loaded.splits.get("test", [])
    tested = [] if set(held_out) & set(loaded.views(views.split)) else [loaded.stem(i) for i in held_out]
    if tested:
        beside = PhotoPictures(out / "views", tested, pictures)
    where = {"split": views.split, "seed": training.seed, "device": training.device}
    gaussians = fit_color(loaded, out, config, **where, report=say, progress=True)
    say(repr(gaussians))
    written = [out / "color.ply"]
    if tested:
        scores = score_views(gaussians, loaded, "test", show=beside)
        write_json(out / "scores.json", {"color": scores.to_json()})
        say(str(scores))
        written += [*beside.written, out / "scores.json"]
    else:
        say("note: no views are held out (split 'test', not trained on): nothing to score against")
    wrote(written)
