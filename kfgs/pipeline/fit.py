"""Make a semantic field from teacher maps and posed images: fuse in 3-D, then compress; or the paper's Figure 2.

Each step is a stage in the run folder. A finished stage is found again by the hash of its inputs. The longest one (the field)
also resumes from its last checkpoint.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .._card import short_repr
from .._files import check_output, folded_name, read_json, real_path, write_json
from .._progress import Progress, as_progress
from .._typed import typed
from ..cameras import Camera
from ..fields import (
    FieldFit,
    GaussianParams,
    SemanticField,
    fit_field,
    scene_classes,
)
from ..fields.decoders import Autoencoded, Codewords, Decoder, Identity
from ..fields.store import NAME, check_place, holds_field
from ..gaussians import Gaussians
from ..quant import (
    Autoencoder,
    Codebook,
    IndexMaps,
    LatentMaps,
    LinearLatents,
    fit_autoencoder,
    fit_codebook,
    quantize_maps,
)
from ..scenes import Scene
from .color import ColorConfig
from .config import FitConfig
from .fuse import answers_stage, find_geometry, uplift_stage
from .maps import KnownFeatures, Maps, as_maps, check_readable, digest_changes, map_digests, map_shape, maps_of_views
from .points import with_points
from .stages import Run, Stage, digest_scene, digest_tensors, stage_generator
from .train import check_scene, field_stage, training_device, with_extent

REPORT, TITLE = "report.html", "<title>kfgs: "
PICTURES = ("preview.png", "codebook.png", "field.png")  # with the report, what `write_run_report` writes


@dataclass(frozen=True, eq=False)
class FitResult:
    """A finished run."""

    field: SemanticField
    folder: Path
    stages: list[Stage]

    __repr__ = short_repr

    @property
    def field_path(self) -> Path:
        """The file of the saved field."""
        return self.folder / NAME

    @property
    def seconds(self) -> float:
        """Total time of the stages; reused ones count with their original time."""
        return sum(stage.seconds for stage in self.stages)


@dataclass(frozen=True)
class _Job:
    """One call of `fit_scene`: the values that all of its stages need."""

    run: Run
    scene: Scene
    views: list[int]
    maps: Maps
    features: dict[str, Any]
    """Identity of the maps, as JSON."""
    config: FitConfig
    device: torch.device
    progress: Progress

    @property
    def cameras(self) -> list[Camera]:
        """The cameras of the views."""
        return [self.scene.cameras[i] for i in self.views]

    def generator(self, stage: str) -> torch.Generator:
        """The random numbers of a stage."""
        return stage_generator(self.config.seed, stage)


def _codebook_stage(job: _Job) -> tuple[Codebook, Stage]:
    """Adaptive Data Compression, Sec. 3.3.1: the codebook S."""
    run, config = job.run, job.config

    def make(folder: Path) -> None:
        check_readable(job.maps, "the codebook")
        book = fit_codebook(job.maps, config.codebook, generator=job.generator("codebook"), progress=job.progress)
        book.save(folder / "codebook.safetensors")
        assert book.report is not None
        if book.report.note is not None:
            run.say(f"note: {book.report.note}")
        write_json(folder / "history.json", book.report.history)

    inputs = {"features": job.features, "config": asdict(config.codebook), "seed": config.seed}
    stage = run.stage("codebook", inputs, make)
    return Codebook.load(stage.folder / "codebook.safetensors"), stage


def _index_stage(job: _Job, codebook: Codebook, upstream: Stage) -> tuple[IndexMaps, Stage]:
    """Quantisation, Eq. 5: the index map M of every view."""
    inputs = {"features": job.features, "codebook": upstream.key}

    def make(folder: Path) -> None:
        check_readable(job.maps, "quantisation")
        maps = quantize_maps(job.maps, codebook, progress=job.progress is True)
        maps.save(folder / "index_maps.safetensors")

    stage = job.run.stage("index_maps", inputs, make)
    return IndexMaps.load(stage.folder / "index_maps.safetensors"), stage


def _autoencoder_stage(job: _Job, codebook: Codebook, upstream: Stage) -> tuple[Autoencoder, Stage]:
    """Semantic Compression, Sec. 3.3.2: encoder E and decoder Psi."""
    config = job.config

    def make(folder: Path) -> None:
        made = fit_autoencoder(
            codebook, config.autoencoder, generator=job.generator("autoencoder"), progress=job.progress
        )
        made.save(folder / "autoencoder.safetensors")
        assert made.report is not None
        write_json(folder / "history.json", made.report.history)

    inputs = {"codebook": upstream.key, "config": asdict(config.autoencoder), "seed": config.seed}
    stage = job.run.stage("autoencoder", inputs, make)
    return Autoencoder.load(stage.folder / "autoencoder.safetensors"), stage


def _field_stage(job: _Job, targets: Sequence[Tensor], inputs: dict[str, Any]) -> GaussianParams:
    """The decoupled field, Sec. 3.2: Gaussians whose rendered latents follow the targets (Eq. 4)."""
    scene, config = job.scene, job.config
    field = with_extent(config.field, scene)
    options = field.identity()
    extent = options.pop("extent")
    inputs = inputs | {
        "scene": digest_scene(scene, job.views),
        "extent": extent,
        "config": options,
        "seed": config.seed,
    }

    def train(checkpoint: Path) -> FieldFit:
        generator = job.generator("field")
        start = GaussianParams.from_points(scene.points, int(targets[0].shape[-1]), generator=generator)
        start = start.map(lambda value: value.to(job.device))
        return fit_field(
            start, job.cameras, targets, field, generator=generator, progress=job.progress, checkpoint=checkpoint
        )

    return field_stage(job.run, "field", inputs, train)[0]


def _check_inputs(scene: Scene, views: Sequence[int], maps: Maps, config: FitConfig) -> None:
    """Check inputs that would otherwise fail only after the first stages."""
    split = config.split
    if config.needs_maps:
        check_readable(maps, "mode 'decouple'")
    if len(views) != len(maps):
        raise ValueError(
            f"maps: expected one teacher map per view of split {split!r} ({len(views)}), got {len(maps)}; "
            f"read them with FeatureFolder(path).of(scene, {split!r})"
        )
    check_scene(scene, views)
    stems = getattr(maps, "stems", None)
    if stems is not None and [Path(folded_name(stem)).name for stem in stems] != [
        Path(folded_name(scene.stem(i))).name for i in views
    ]:
        raise ValueError(
            f"maps: expected the maps of the views of split {split!r} in their order ({scene.stem(views[0])}, "
            f"...), got {stems[0]}, ...; read them with FeatureFolder(path).of(scene, {split!r})"
        )
    if hasattr(maps, "check_files"):
        maps.check_files()


@typed
def fit_scene(
    scene: Scene,
    maps: Maps | Sequence[Tensor],  # teacher maps of the views of config.split, in their order
    folder: str | Path,
    config: FitConfig | None = None,
    *,
    splat: Gaussians | str | Path | None = None,
    latents: LinearLatents | None = None,
    report: Callable[[str], None] | None = None,
    progress: Progress = False,
) -> FitResult:
    """Make a semantic field of a scene; finished stages in the run folder are reused.

    Args:
        scene: posed, undistorted views with their sparse points; if it has none and training needs them, they are
            triangulated first.
        maps: one teacher map [h, w, D] per training view; read one at a time; a `FeatureFolder`, or a list in memory. When
            the stages that read them are finished, the maps may be deleted (`discard_maps`), except for the paper's mode
            `decouple`.
        folder: the run folder; the finished field goes to `folder/field.kfgs`. It replaces a field that other options made there,
            and the report of that one. The stages stay, so going back to the old options is quick.
        config: the method and its options.
        splat: of method `fuse`, the Gaussians to fuse onto, in the scene's frame, or a splat file. None takes
            `scene.splat`; if the scene has none, it trains them on the pictures with `config.color` and writes them to
            `folder/color.ply`, unless that file exists. If `fit_color` trained for longer in the same folder, its Gaussians are
            taken instead.
        latents: of method `fuse`, those of other fields (`fields.sample_latents`), with which this one shall agree.
        report: receives one line per stage.
        progress: True shows bars; a function receives the history rows of every trained stage as they appear.

    Raises:
        TypeError: if `maps` is neither, or `progress` neither a bool nor a function.
        ValueError: if the counts of views and maps differ, a camera has distortion, there is no such device, a splat is given
            to the paper's method, or its mode `decouple` gets `RecomputedMaps`; if a map's file is damaged; if `folder` is a
            file, or another process works in it.
        FileExistsError: if `folder/field.kfgs` is not a field.
        FileNotFoundError: if a stage needs maps that were discarded, or a picture is missing.
    """
    config, progress, maps = config or FitConfig(), as_progress(progress), as_maps(maps)
    target_device = training_device(config.device)
    _check_inputs(scene, scene.views(config.split), maps, config)
    if splat is not None and config.method == "paper":
        raise ValueError("splat: expected none for method 'paper', which trains its own Gaussians; leave it out")
    if latents is not None and config.method == "paper":
        raise ValueError("latents: expected none for method 'paper', whose autoencoder makes them; leave it out")
    run = Run(check_output("folder", folder, "a folder"), report)
    with run.locked():
        check_place(run.folder / NAME)
        if config.method == "paper" or (splat is None and scene.splat is None):  # else nothing is trained
            scene = with_points(run, scene, scene.views(config.split), config.seed, progress)
        job = _job(run, scene, maps, config, target_device, progress)
        found, about = _make_field(job, splat, latents)
        done = FitResult(found, run.folder, run.stages)
        about |= _facts(job, getattr(maps, "identity", None))
        folder = scene.folder
        classes = None if folder is None else scene_classes(folder, found.dim)
        done = replace(done, field=replace(found, info=about, classes=classes))
        replace_field(run.folder, done.field)
    return done


def replace_field(folder: Path, field: SemanticField) -> None:
    """Write the field of a run folder in one step. The report of an older one is deleted first: a kill leaves no wrong report."""
    if not holds_field(folder / NAME, vars(field)):
        for name in (REPORT, *PICTURES):
            (folder / name).unlink(missing_ok=True)
        field.save(folder / NAME)


def _facts(job: _Job, teacher: Any) -> dict[str, Any]:
    """The `info` of a field about its origin."""
    scene, stages = job.scene, job.run.stages
    return {
        "seed": job.config.seed,
        "views": [camera.name for camera in job.cameras],
        "teacher_map": list(map_shape(job.maps)),
        **({"teacher": teacher} if teacher else {}),
        **({} if scene.folder is None else {"scene": str(real_path(scene.folder))}),
        "seconds": {stage.name: round(stage.seconds, 3) for stage in stages},
        "kfgs": version("kfgs"),
    }


def _make_field(
    job: _Job, splat: Gaussians | str | Path | None, latents: LinearLatents | None = None
) -> tuple[SemanticField, dict[str, Any]]:
    """All stages of a method: the field, and what decided it, for its `info`."""
    config = job.config
    if config.method == "paper":
        about = {"method": config.method, "mode": config.mode, "steps": {"field": config.field.steps}}
        return answers_stage(job.run, _paper_stages(job), job.cameras), about
    inputs = {"features": job.features, "config": asdict(config.uplift), "seed": config.seed}
    if latents is not None:
        inputs["latents"] = digest_tensors(latents.basis)
    given = job.run, job.scene, splat, _color_config(config), job.device, job.progress
    geometry, origin = find_geometry(*given)
    options = config.uplift, inputs, job.progress is True, latents
    found = uplift_stage(job.run, geometry, job.cameras, job.maps, *options)
    return found, {"method": config.method, **origin}


def _paper_stages(job: _Job) -> SemanticField:
    """Figure 2: codebook, index maps, autoencoder, and Gaussians trained on the latent maps."""
    mode = job.config.mode
    targets: Sequence[Tensor] = KnownFeatures(job.maps)
    decoder: Decoder = Identity(map_shape(job.maps)[-1])
    if mode == "decouple":
        inputs: dict[str, Any] = {"mode": mode, "features": job.features}
    else:
        codebook, made = _codebook_stage(job)
        index_maps, indexed = _index_stage(job, codebook, made)
        inputs = {"mode": mode, "index_maps": indexed.key}
        targets, decoder = LatentMaps(index_maps, codebook.codewords), Codewords(codebook)
        if mode == "adc+sc":
            autoencoder, compressed = _autoencoder_stage(job, codebook, made)
            inputs["autoencoder"], decoder = compressed.key, Autoencoded(codebook, autoencoder)
            with torch.no_grad():
                targets = LatentMaps(index_maps, autoencoder.encode(codebook.codewords))
    return SemanticField(_field_stage(job, targets, inputs).activated().detach(), decoder)


def _job(run: Run, scene: Scene, maps: Maps, config: FitConfig, device: torch.device, progress: Progress) -> _Job:
    views = scene.views(config.split)
    seen = maps_of_views(scene, views, maps, undistorted=config.undistorted_features)
    features = {"files": map_digests(run, seen), "lenses": digest_changes(seen)}
    return _Job(run, scene, views, seen, features, config, device, progress)


def _color_config(config: FitConfig) -> ColorConfig:
    return replace(config.color, seed=config.seed, split=config.split)


def load_history(stage: Stage) -> list[dict[str, Any]]:
    """The history rows of a finished stage; empty if it has none."""
    path = stage.folder / "history.json"
    return list(read_json(path)) if path.is_file() else []
