"""Make a semantic field from posed images and teacher maps: fuse in 3-D, then compress; or the paper's Figure 2.

Each step is a stage in the run folder, found again by the digest of its inputs. Training resumes from its last checkpoint.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import asdict, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor

from .._check import Progress, as_progress
from .._files import check_output, folded_name, locked, real_path, write_json
from ..cameras.resample import check_layout
from ..fields import SemanticField, fit_field, fuse_views, gaussians_from_points, uplift_maps
from ..fields.decoders import Autoencoded, Codewords, Decoder, Identity
from ..fields.store import NAME, check_place, scene_classes
from ..fields.train import digest_tensors
from ..formats import read_splats, write_splats
from ..formats.table import splat_file_of
from ..gaussians import Gaussians
from ..quant import Autoencoder, Codebook, LatentMaps, fit_autoencoder, fit_codebook, quantize_maps
from ..quant.maps import FeatureMaps, IndexMaps
from ..scenes import FeatureFolder, Scene, extract_features
from ..scenes.scene import as_taken
from .color import color_stage, find_color
from .maps import KnownFeatures, as_maps, describe_maps, map_shape, maps_of_views
from .methods import Paper, Uplift, changes
from .stages import LOCK, Run, Stage, digest_cameras, digest_scene, digest_shape
from .train import field_stage, stage_gaussians, training_device, training_views, with_extent, with_points

REPORT = ("report.html", "preview.png", "codebook.png", "field.png")  # what `write_run_report` writes


def fit(
    scene: Scene,
    maps: Any,
    method: Uplift | Paper | None = None,
    *,
    folder: str | Path | None = None,
    split: str = "train",
    seed: int = 0,
    report: Callable[[str], None] | None = None,
    progress: Progress = False,
) -> SemanticField:
    """Make a semantic field of a scene; finished stages in the run folder are reused.

    Args:
        scene: posed, undistorted views. If it has too few points and training needs them, they are triangulated first.
        maps: one teacher map [h, w, D] for each view of the split, in their order: a `FeatureFolder`, or tensors in memory.
            Or a teacher, whose maps are then stored in `folder/features`. They are undistorted like the pictures.
        method: `Uplift()`, the default, or `Paper()`, with their options.
        folder: the run folder; it receives the stages and `field.kfgs`, in place of a field that other options made. Going
            back to the old options is quick, because stages stay. None keeps nothing.
        split: the training views; "all" trains on all views.
        seed: every random choice follows from it.
        report: receives one line per stage.
        progress: True shows bars; a function receives the history rows of every trained stage as they appear.

    Returns:
        The field, on the CPU; its `info` says how it was made, with the seconds of each stage, and of the paper's method
        which options are not the paper's. Codebook, index maps, autoencoder and training are computed on the GPU if there is
        one (`CUDA_VISIBLE_DEVICES=""` hides it).

    Raises:
        TypeError: if `maps` are neither maps nor a teacher, or `method` is neither.
        ValueError: if the counts of views and maps differ, a camera has distortion, a map's file is damaged, or another process
            works in the folder.
        FileNotFoundError: if a picture is missing.
    """
    method, progress = method or Uplift(), as_progress(progress)
    if not isinstance(method, Uplift | Paper):
        raise TypeError(f"method: expected Uplift() or Paper(), got {type(method).__name__}; pass one of them")
    views = training_views(scene, split)
    kept = None if folder is None else check_output("folder", folder, "a folder")
    if kept is not None:
        check_place(kept / NAME)
    with nullcontext(kept) if kept is not None else TemporaryDirectory(prefix="kfgs-") as place:
        run = Run(Path(place), report, seed, progress)
        maps = _open_maps(maps, scene, split, run.folder / "features", progress is True)
        with locked(run.folder, LOCK):
            if isinstance(method, Paper) or method.splat is None:  # else nothing is trained
                scene = with_points(run, scene, views)
            seen = maps_of_views(scene, views, maps)
            make = _uplift if isinstance(method, Uplift) else _paper
            field, about = make(run, scene, views, seen, method)  # type: ignore[arg-type]
            info = {
                **about,
                "seed": seed,
                "views": [scene.cameras[i].name for i in views],
                "teacher_map": list(map_shape(seen)),
                "seconds": {stage.name: round(stage.seconds, 3) for stage in run.stages},
                "stages": [stage.folder.name for stage in run.stages],
                "kfgs": version("kfgs"),
            }
            if getattr(maps, "identity", None):
                info["teacher"] = maps.identity
            if scene.folder is not None:
                info["scene"] = str(real_path(scene.folder))
            classes = None if scene.folder is None else scene_classes(scene.folder, field.dim)
            field = replace(field, info=info, classes=classes)
            if kept is not None:
                for name in REPORT:  # of an older field: a kill leaves no wrong report
                    (kept / name).unlink(missing_ok=True)
                field.save(kept / NAME)
    return field


def _open_maps(maps: Any, scene: Scene, split: str, folder: Path, progress: bool) -> FeatureMaps:
    """The maps of a split's views; a teacher's go to the folder. What would fail only after the first stages is an error."""
    if hasattr(maps, "encode_image"):
        extract_features(maps, as_taken(scene), folder, split=split, overwrite=True, progress=progress)
        maps = FeatureFolder(folder).of(scene, split)
    maps = as_maps(maps)
    wanted = [Path(folded_name(scene.stem(i))).name for i in scene.views(split)]
    given = [Path(folded_name(stem)).name for stem in getattr(maps, "stems", wanted)]
    if len(wanted) != len(maps) or given != wanted:
        got = f"{len(maps)}" if given == wanted else f"{len(maps)} ({given[0]}, ...)"
        raise ValueError(
            f"maps: expected one teacher map for each of the {len(wanted)} views of split {split!r}, in their order "
            f"({wanted[0]}, ...), got {got}; read them with FeatureFolder(path).of(scene, {split!r})"
        )
    if hasattr(maps, "check_files"):
        maps.check_files()
    else:
        check_layout("maps[0]", map_shape(maps), scene.cameras[scene.views(split)[0]].size)
    return maps


def _uplift(
    run: Run, scene: Scene, views: list[int], maps: FeatureMaps, method: Uplift
) -> tuple[SemanticField, dict[str, Any]]:
    """The maps' features on the Gaussians of a splat, merged and compressed; and facts about the geometry."""
    cameras, options = [scene.cameras[i] for i in views], method.uplift
    latents = None if method.latents is None else digest_tensors(method.latents.basis)
    seen = {"features": describe_maps(run, maps), "cameras": digest_cameras(cameras), "latents": latents}
    geometry, origin = _geometry(run, scene, views, method)
    inputs = seen | {"geometry": digest_shape(geometry), "config": asdict(options), "seed": run.seed, "version": 2}
    scratch = run.scratch("uplift", seen | {"pixels": options.pixels})

    def make(folder: Path) -> None:
        given, generator = (geometry.to("cpu"), cameras, maps, options), run.generator("uplift")
        bar = run.progress is True
        field = uplift_maps(*given, latents=method.latents, generator=generator, scratch=scratch, progress=bar)
        field.save(folder / NAME)

    stage = run.stage("uplift", inputs, make)
    shutil.rmtree(scratch, ignore_errors=True)
    field = SemanticField.load(stage.folder)
    left_out, own = field.info["explained"]
    run.say(
        f"{field.dim} channels as {field.decoder.latent} latents; {len(field)} of {len(geometry)} Gaussians left; half of the "
        f"views explains {left_out:.0%} of the teacher's variation in the other half, {own:.0%} in its own"
    )
    if "note" in field.info:
        run.say(f"note: {field.info['note']}")
    return field, {"method": "uplift", **origin, **field.info}


def _geometry(run: Run, scene: Scene, views: list[int], method: Uplift) -> tuple[Gaussians, dict[str, Any]]:
    """The Gaussians to fuse onto, and where they are from."""
    splat = method.splat
    if isinstance(splat, Gaussians):
        return splat, {"geometry": "given"}
    if splat is not None:
        return read_splats(splat), {"geometry": str(splat_file_of(splat))}
    longer = find_color(run, scene, views, method.color)
    gaussians, steps = longer or (color_stage(run, scene, views, method.color), method.color.training.steps)
    if longer is None and not (run.folder / "color.ply").exists():
        write_splats(gaussians, run.folder / "color.ply")
    return gaussians, {"geometry": "trained on the pictures", "steps": {"color": steps}}


def _paper(
    run: Run, scene: Scene, views: list[int], maps: FeatureMaps, method: Paper
) -> tuple[SemanticField, dict[str, Any]]:
    """Figure 2: codebook, index maps, autoencoder, Gaussians trained on the latent maps, and what the views show of each."""
    targets: Sequence[Tensor] = KnownFeatures(maps)
    decoder: Decoder = Identity(map_shape(maps)[-1])
    features, device = {"features": describe_maps(run, maps)}, training_device()
    inputs: dict[str, Any] = dict(features)
    if method.codebook is not None:  # Adaptive Data Compression, Sec. 3.3.1: the codebook S
        book = _learn(run, "codebook", features, method.codebook, partial(fit_codebook, maps, device=device))
        codebook = Codebook.load(book.folder / "codebook.safetensors")

        def quantize(folder: Path) -> None:  # Eq. 5: the index map M of every view
            indices = quantize_maps(maps, codebook.to(device), progress=run.progress is True)
            indices.save(folder / "index_maps.safetensors")

        indexed = run.stage("index_maps", features | {"codebook": book.key}, quantize)
        inputs, latents, decoder = {"index_maps": indexed.key}, codebook.codewords, Codewords(codebook)
        if method.autoencoder is not None:  # Semantic Compression, Sec. 3.3.2: encoder E and decoder Psi
            learn = partial(fit_autoencoder, codebook.to(device))
            coder = _learn(run, "autoencoder", {"codebook": book.key}, method.autoencoder, learn)
            autoencoder = Autoencoder.load(coder.folder / "autoencoder.safetensors")
            inputs["autoencoder"], decoder = coder.key, Autoencoded(codebook, autoencoder)
            with torch.no_grad():
                latents = autoencoder.encode(codebook.codewords)
        targets = LatentMaps(IndexMaps.load(indexed.folder / "index_maps.safetensors"), latents)
    # the decoupled field, Sec. 3.2: Gaussians whose rendered latents follow the targets (Eq. 4)
    cameras, training = [scene.cameras[i] for i in views], with_extent(method.training, scene)
    inputs |= {"scene": digest_scene(scene, views), "config": asdict(training), "seed": run.seed}
    start = partial(gaussians_from_points, scene.points, decoder.latent)
    train = partial(fit_field, cameras=cameras, targets=targets, training=training)
    trained = field_stage(run, "field", inputs, start, train)
    field = SemanticField(stage_gaussians(trained), decoder)
    fuse = partial(fuse_views, field, cameras)
    answers = run.stage("answers", {"field": trained.key}, lambda folder: fuse().save(folder / NAME))
    book_kind = None if method.codebook is None else type(method.codebook).__name__
    changed = ", ".join(changes(method, Paper.paper())) or "nothing"
    facts = {"method": "paper", "codebook": book_kind, "changed_from_paper": changed}
    return SemanticField.load(answers.folder), facts | {"steps": {"field": training.steps}}


def _learn(
    run: Run, name: str, inputs: dict[str, Any], options: Any, learn: Callable[..., Codebook | Autoencoder]
) -> Stage:
    """The stage of a codebook or an autoencoder: its file, named like the stage, and its history."""

    def make(folder: Path) -> None:
        made = learn(options, generator=run.generator(name), progress=run.progress)
        made.save(folder / f"{name}.safetensors")
        assert made.report is not None
        write_json(folder / "history.json", made.report.history)

    return run.stage(name, inputs | {"config": asdict(options), "seed": run.seed}, make)
