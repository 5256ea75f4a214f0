"""Commands that make fields and what they need: demo, sfm, features, fit, color; and batch, for many scenes."""

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

from .._files import check_output, read_json, read_text, real_path, write_json
from .files import open_field, say, wrote
from .options import Classes, Flag, Given, Name, Positional, SceneFolder, Settings, Teacher, Views

TABLE = "text.safetensors"
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


def features(
    source: Positional[Given[Path]] = None,
    *,
    out: Given[Path] = None,
    words: Name = None,
    examples: Given[Path] = None,
    fast: Flag = False,
    views: Views,
    teacher: Teacher,
) -> None:
    """Run a teacher over a scene's pictures and store its feature maps, and embed the words that you will ask for.

    Pictures are processed one at a time; after a kill, the same command continues with the next picture. Without a teacher,
    existing maps are checked. Other commands take the table of words as --text, and find SCENE/text.safetensors themselves.

    Examples:
        kfgs features scene/ --words wall,floor,chair,plant --teacher lseg --weights demo_e200.ckpt
        kfgs features scene/ --teacher dinov2 --weights facebook/dinov2-small --out maps/
        kfgs features scene/ --out maps/    # checks maps by Feature 3DGS, or in .npy or .safetensors
        kfgs features --words "chair;armchair,plant" --teacher lseg --weights demo_e200.ckpt --out words.safetensors
        kfgs features run/field.kfgs --examples clicks.json --out shown.safetensors    # for a teacher without text

    In clicks.json each class has its examples: {"chair": [{"view": "a.png", "points": [[x, y]]}, {"view": "b.png",
    "box": [x0, y0, x1, y1]}, {"gaussians": [3, 14]}], ...}. A mask of Segment Anything is {"view": "a.png", "segmentation":
    {"size": ..., "counts": ...}}, or {"view": "a.png", "masks": "a.json", "index": 3} for one of a file. An annotations.json
    in the format of COCO will do, too: each category is a class.

    Args:
        source: A scene: folder with images and a COLMAP model or transforms.json. With --examples, the field. Without it, only
            --words are embedded.
        out: Folder for the maps, by default SCENE/features. Without a scene: the table to write (.safetensors). With
            --examples, a picture of them is written next to it (OUT.png): see there whether the clicks hit what you mean.
        words: Words between commas, a .txt file (a class a line), or a .json file (a list). Synonyms follow a semicolon:
            "chair;armchair;seat" is called chair. With a scene they go to SCENE/text.safetensors.
        examples: A .json file of examples, or COCO's annotations, instead of words.
        fast: One pass over each picture instead of the exact evaluation at several scales (lseg).
    """
    from torch import Tensor

    from ..evaluation.coco import load_coco_examples
    from ..fields.examples import read_examples
    from ..scenes.load import scene_root
    from ..viz import draw_examples
    from ..viz.films import show_photos
    from ..viz.pictures import save_picture

    if examples is not None:
        if source is None:
            raise ValueError("source: expected the field of the examples, got none; pass RUN/field.kfgs")
        file, field, content = _table(out), open_field("source", source), read_json(examples)
        coco = isinstance(content, dict) and {"images", "annotations", "categories"} <= set(content)
        shown = load_coco_examples(examples) if coco else read_examples(examples)
        made = kfgs.label_set_from_examples(field, shown)
        made.save(file)
        written, photos = [file], Classes().photos_of(field)
        if photos is not None and any(not isinstance(example, Tensor) for kind in shown.values() for example in kind):
            written.append(file.with_name(f"{file.name}.png"))
            save_picture(written[-1], draw_examples(field.cameras, shown, show_photos(photos)))
        say(f"{len(made)} classes, {made.dim} channels each, by examples: {', '.join(made.names)}")
        wrote(written)
        return
    if source is None and words is None:
        raise ValueError("source, words: expected a scene, or words to embed, got neither; see `kfgs features --help`")
    folder = None if source is None else scene_root(source)
    table = None if words is None else _table(out if folder is None else folder / TABLE)
    if table is not None and teacher.teacher is None:
        raise ValueError("words: expected --teacher with it, whose text encoder embeds them, got none; pass --teacher")
    listed = [] if words is None else read_words(words)
    target = None if folder is None else out or folder / "features"
    if target is not None:
        check_output("out", target, "a folder")
    scene = None if source is None else views.load(source)
    network = teacher.load(**({"fast": True} if fast else {}))
    if table is not None:
        made = kfgs.make_label_set(network, listed)
        made.save(table)
        templates = ", ".join(map(repr, made.info["templates"]))
        say(f"{len(made)} classes, {made.dim} channels each, by {made.info['teacher']['name']}, as {templates}")
        for name, more in made.info["synonyms"].items():
            say(f"  {name}: also {', '.join(more)}")
    if target is not None:
        _make_maps(network, scene, target, views.split)
        given = "" if out is None else f" --features {out}"
        say(f"next: kfgs fit {source} --out run{given}" + ("" if views.split == "train" else f" --split {views.split}"))
    if network is not None:
        wrote([place for place in (table, target) if place is not None])


def _make_maps(network: Any, scene: Any, target: Path, split: str) -> None:
    """Make the maps of a teacher; without one, check those that are there."""
    if network is not None:
        kfgs.extract_features(network, scene, target, split, progress=True)
        maps = kfgs.FeatureFolder(target).of(scene, split)
        teacher = (maps.identity or {}).get("name", "unknown")
        say(f"{len(maps)} maps of {' x '.join(map(str, maps.shape))} by {teacher}")
        return
    if not target.is_dir():
        raise ValueError(f"teacher: expected a teacher, or maps in {target} to check, got neither; pass --teacher")
    problems, count = kfgs.FeatureFolder(target).check(scene, split), len(scene.views(split))
    say(f"{target}: {count - len(problems)} of {count} views have a map that fits")
    for name, text in problems.items():
        say(f"{name}: {text}")
    if problems:
        raise ValueError(
            f"out: expected a map that fits for each of the {count} views of split {split!r}, got {len(problems)} that are "
            "missing or do not fit (named above); make these maps again, or name the photos to use in SCENE/split.json"
        )


def _table(out: Path | None) -> Path:
    """The file of a table, checked."""
    table = Path(TABLE) if out is None else out
    if table.suffix != ".safetensors" or table.is_dir():
        raise ValueError(f"out: expected a file whose name ends in .safetensors, got {table}; give another name")
    check_output("out", table, "a file")
    return table


def read_words(words: str) -> list[str]:
    """Class names from a .json list, a .txt file with a class a line, or words between commas.

    Text with neither ending is words, even if a folder has the same name; a file with another ending is an error.
    """
    kind = Path(words).suffix.lower()
    listed: Any = words.split(",")
    if kind == ".json":
        listed = read_json(words, "a JSON file with a list of classes")
    elif kind == ".txt":
        listed = read_text(words, "a text file with a class a line").splitlines()
    elif os.path.isfile(words):  # False, not an error, for words that no file name could hold
        raise ValueError(
            f"words: expected a .json or .txt file, or words between commas, got {words}; write one of these"
        )
    if not isinstance(listed, list) or not all(isinstance(word, str) for word in listed):
        raise ValueError(
            f'words: expected a list of words like ["wall", "floor"] in {words}, got {listed!r:.80}; write one'
        )
    listed = [word.strip() for word in listed if word.strip()]
    if not listed:
        raise ValueError(f"words: expected at least one word, got none in {words!r}; write wall,floor or name a file")
    return listed


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
            raise ValueError(
                "blocks: expected a scene with features/, got --teacher, --weights or --text; leave these out"
            )
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
