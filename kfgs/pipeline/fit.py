"""Teacher maps and posed images in, a saved semantic field out: fused in 3-D and then compressed, or as the paper's Figure 2.

Each call is a stage of a run folder: finished stages are found again by the hash of their inputs, and the long one
(the field) also resumes from its last checkpoint.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from dataclasses import field as default
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from .._check import check_choice
from .._files import digest_value, read_json, write_json
from ..fields import (
    FieldConfig,
    FieldFit,
    GaussianParams,
    SemanticField,
    UpliftConfig,
    fit_field,
    remember,
)
from ..formats import SplatFile
from ..gaussians import Gaussians
from ..quant import (
    Autoencoder,
    AutoencoderConfig,
    Codebook,
    CodebookConfig,
    IndexMaps,
    LatentMaps,
    fit_autoencoder,
    fit_codebook,
    quantize_maps,
)
from ..scenes import Scene
from .color import ColorConfig
from .device import training_device
from .digests import describe_lens, digest_scene, stage_generator
from .fuse import answers_stage, find_geometry, uplift_stage
from .maps import KnownFeatures, Maps, UndistortedMaps, check_readable, map_digests, map_shape
from .stages import Run, Stage
from .train import check_scene, field_stage

Method = Literal["fuse", "paper"]
METHODS: tuple[Method, ...] = ("fuse", "paper")
Mode = Literal["decouple", "adc", "adc+sc"]
MODES: tuple[Mode, ...] = ("decouple", "adc", "adc+sc")


@dataclass(frozen=True)
class FitConfig:
    """What a run does."""

    method: Method = "fuse"
    """`fuse`: features are averaged onto sharp Gaussians in 3-D, merged and compressed after (`fields.uplift_maps`).
    `paper`: maps are compressed per pixel, and Gaussians are trained on them (Sec. 3)."""
    mode: Mode = "adc+sc"
    """Of method `paper`, rows of Table 1: `decouple` (raw features), `adc` (+ codebook), `adc+sc` (+ codebook + autoencoder)."""
    seed: int = 0
    """Every random choice of the run follows from it."""
    split: str = "train"
    """Which views of the scene are learnt from."""
    undistorted_features: bool = False
    """Whether the teacher saw undistorted pictures; otherwise the lens is removed from its maps as from the pictures."""
    uplift: UpliftConfig = default(default_factory=UpliftConfig.field)
    """Of method `fuse`."""
    color: ColorConfig = default(default_factory=ColorConfig.geometry)
    """Of method `fuse`: how Gaussians are trained to fuse onto, where there is no splat."""
    codebook: CodebookConfig = default(default_factory=CodebookConfig)
    """This and the rest: of method `paper`."""
    autoencoder: AutoencoderConfig = default(default_factory=AutoencoderConfig)
    field: FieldConfig = default(default_factory=FieldConfig)

    def __post_init__(self) -> None:
        check_choice("method", self.method, METHODS)
        check_choice("mode", self.mode, MODES)

    @property
    def needs_maps(self) -> bool:
        """Whether the field learns from the dense maps themselves, so that they must be stored and stay."""
        return self.method == "paper" and self.mode == "decouple"

    @staticmethod
    def paper(**changes: Any) -> FitConfig:
        """The paper's method and schedule: 28 epochs, 5,000 autoencoder steps, 30,000 field steps. For a workstation."""
        options: dict[str, Any] = {"codebook": CodebookConfig.paper(), "autoencoder": AutoencoderConfig.paper()}
        return FitConfig(**{"method": "paper", **options, **changes})

    @staticmethod
    def cpu(**changes: Any) -> FitConfig:
        """For two CPU cores: the same as `FitConfig()`, and 2,000 field steps where the method is the paper's."""
        return FitConfig(**{"field": FieldConfig.cpu(), **changes})


@dataclass(frozen=True, eq=False)
class FitResult:
    """A finished run."""

    field: SemanticField
    folder: Path
    stages: list[Stage]

    @property
    def field_path(self) -> Path:
        """Where the field was saved."""
        return self.folder / "field"

    @property
    def seconds(self) -> float:
        """Time spent making the stages, reused ones counted with what they took when they were made."""
        return sum(stage.seconds for stage in self.stages)


def _lens_digest(maps: Maps) -> str | None:
    if not isinstance(maps, UndistortedMaps):
        return None
    return digest_value([describe_lens(lens) for lens in maps.lenses])


def _codebook_stage(
    run: Run, maps: Maps, features: dict[str, Any], config: FitConfig, options: dict[str, Any]
) -> tuple[Codebook, Stage]:
    """Adaptive Data Compression, Sec. 3.3.1: the codebook S."""

    def make(folder: Path) -> None:
        check_readable(maps, "the codebook")
        fit = fit_codebook(maps, config.codebook, generator=stage_generator(config.seed, "codebook"), **options)
        fit.codebook.save(folder / "codebook.safetensors")
        if fit.note is not None and run.report is not None:
            run.report(f"note: {fit.note}")
        write_json(folder / "history.json", fit.history)

    inputs = {"features": features, "config": asdict(config.codebook), "seed": config.seed}
    stage = run.stage("codebook", inputs, make)
    return Codebook.load(stage.folder / "codebook.safetensors"), stage


def _index_stage(
    run: Run, maps: Maps, features: dict[str, Any], codebook: Codebook, upstream: Stage, progress: bool
) -> tuple[IndexMaps, Stage]:
    """Quantisation, Eq. 5: the index map M of every view; a killed one goes on with the view it was at."""
    inputs = {"features": features, "codebook": upstream.key}
    scratch = run.scratch("index_maps", inputs)

    def make(folder: Path) -> None:
        check_readable(maps, "quantisation")
        quantize_maps(maps, codebook, progress=progress, scratch=scratch).save(folder / "index_maps.safetensors")

    stage = run.stage("index_maps", inputs, make)
    shutil.rmtree(scratch, ignore_errors=True)
    return IndexMaps.load(stage.folder / "index_maps.safetensors"), stage


def _autoencoder_stage(
    run: Run, codebook: Codebook, upstream: Stage, config: FitConfig, options: dict[str, Any]
) -> tuple[Autoencoder, Stage]:
    """Semantic Compression, Sec. 3.3.2: encoder E and decoder Psi."""

    def make(folder: Path) -> None:
        fit = fit_autoencoder(
            codebook, config.autoencoder, generator=stage_generator(config.seed, "autoencoder"), **options
        )
        fit.autoencoder.save(folder / "autoencoder.safetensors")
        write_json(folder / "history.json", fit.history)

    inputs = {"codebook": upstream.key, "config": asdict(config.autoencoder), "seed": config.seed}
    stage = run.stage("autoencoder", inputs, make)
    return Autoencoder.load(stage.folder / "autoencoder.safetensors"), stage


def _field_stage(
    run: Run,
    scene: Scene,
    views: Sequence[int],
    targets: Sequence[Tensor],
    inputs: dict[str, Any],
    config: FitConfig,
    device: torch.device,
    options: dict[str, Any],
) -> tuple[GaussianParams, Stage]:
    """The decoupled field, Sec. 3.2: Gaussians whose rendered latents follow the targets (Eq. 4)."""
    inputs = inputs | {
        "scene": digest_scene(scene, views),
        "extent": float(scene.extent),
        "config": asdict(config.field),
        "seed": config.seed,
    }

    def train(checkpoint: Path) -> FieldFit:
        generator = stage_generator(config.seed, "field")
        start = GaussianParams.from_points(scene.points, int(targets[0].shape[-1]), generator=generator)
        return fit_field(
            start.map(lambda value: value.to(device)),
            [scene.cameras[i] for i in views],
            targets,
            config.field,
            extent=scene.extent,
            generator=generator,
            checkpoint=checkpoint,
            **options,
        )

    return field_stage(run, "field", inputs, train)


def _check_inputs(scene: Scene, views: Sequence[int], maps: Maps, config: FitConfig) -> None:
    """Refuse what would fail only after the first stages are done."""
    split = config.split
    if config.needs_maps:
        if getattr(maps, "recomputed", False):
            raise ValueError(
                "maps: expected stored maps for mode 'decouple', which looks at one in every step, got maps that run the "
                "teacher each time; store them with extract_features, or use another mode"
            )
        check_readable(maps, "mode 'decouple'")
    if len(views) != len(maps):
        raise ValueError(
            f"maps: expected one teacher map per view of split {split!r} ({len(views)}), got {len(maps)}; "
            f"read them with FeatureFolder(path).of(scene, {split!r})"
        )
    check_scene(scene)
    stems = getattr(maps, "stems", None)
    if stems is not None and [Path(stem).name for stem in stems] != [Path(scene.stem(i)).name for i in views]:
        raise ValueError(
            f"maps: expected the maps of the views of split {split!r} in their order ({scene.stem(views[0])}, "
            f"...), got {stems[0]}, ...; read them with FeatureFolder(path).of(scene, {split!r})"
        )


def fit_scene(
    scene: Scene,
    maps: Maps,  # teacher maps of the views of config.split, in their order
    folder: str | Path,
    config: FitConfig | None = None,
    *,
    splat: Gaussians | SplatFile | str | Path | None = None,
    report: Callable[[str], None] | None = None,
    progress: bool = False,
    callback: Callable[[dict[str, Any]], None] | None = None,
    device: str | torch.device = "auto",
) -> FitResult:
    """Make a semantic field of a scene, resuming whatever a run folder already holds.

    Args:
        scene: posed, undistorted views with their sparse points.
        maps: one teacher map [h, w, D] per training view; read one at a time. Once the stages made of them are in the run
            folder the maps may be gone (`discard_maps`), except for the paper's mode `decouple`.
        folder: the run folder; `folder/field` receives the finished field.
        config: the method and its options.
        splat: of method `fuse`, the Gaussians to fuse onto, in the scene's frame: a splat file or its content. None trains them
            on the pictures with `config.color` (`folder/color.ply`), or takes those of a longer `fit_color` in the same folder.
        report: receives one line per stage.
        progress: show progress bars.
        callback: receives the history rows of every trained stage as they appear.
        device: where a field is trained, see `training_device`; the other stages and the result stay on the CPU.

    Raises:
        ValueError: if the counts of views and maps differ, a camera has distortion, there is no such device, a splat is given
            to the paper's method, or its mode `decouple` gets maps that run the teacher at each look (`RecomputedMaps`).
        FileNotFoundError: if a stage is to be made of maps that were discarded, or a picture is missing.
    """
    config = config or FitConfig()
    target_device = training_device(device)
    views = scene.views(config.split)
    _check_inputs(scene, views, maps, config)
    if splat is not None and config.method == "paper":
        raise ValueError("splat: expected none for method 'paper', which trains its own Gaussians; leave it out")
    run = Run(Path(folder), report)
    options: dict[str, Any] = {"progress": progress, "callback": callback}
    teacher = getattr(maps, "identity", None)
    lenses = [] if scene.lenses is None else [scene.lenses[i] for i in views]
    if lenses and not config.undistorted_features:
        maps = UndistortedMaps(maps, lenses)
    features = {"files": map_digests(run, maps), "lenses": _lens_digest(maps)}
    cameras = [scene.cameras[i] for i in views]
    if config.method == "fuse":
        color = replace(config.color, seed=config.seed, split=config.split)
        geometry, where = find_geometry(run, scene, splat, color, target_device, options)
        found = uplift_stage(run, geometry, cameras, maps, features, config.uplift, config.seed, progress)
        about: dict[str, Any] = {"geometry": where}
    else:
        found = _paper_stages(run, scene, views, maps, features, config, target_device, options)
        found = answers_stage(run, found, cameras)
        about = {"mode": config.mode}
    done = FitResult(found, Path(folder), run.stages)
    info = {
        "method": config.method,
        **about,
        "seed": config.seed,
        "views": [camera.name for camera in cameras],
        "teacher_map": list(map_shape(maps)),
        **({"teacher": teacher} if teacher else {}),
        **({} if scene.folder is None else remember(scene.folder, done.field_path)),
        "seconds": {stage.name: round(stage.seconds, 3) for stage in run.stages},
        "kfgs": version("kfgs"),
    }
    done = replace(done, field=replace(found, info=info, folder=done.field_path))
    if not _is_saved(done.field, done.field_path):
        done.field.save(done.field_path)
    return done


def _paper_stages(
    run: Run,
    scene: Scene,
    views: Sequence[int],
    maps: Maps,
    features: dict[str, Any],
    config: FitConfig,
    device: torch.device,
    options: dict[str, Any],
) -> SemanticField:
    """Figure 2: codebook, index maps, autoencoder, and Gaussians trained on what they make of the maps."""
    codebook, autoencoder = None, None
    targets: Sequence[Tensor] = KnownFeatures(maps)
    if config.mode == "decouple":
        inputs: dict[str, Any] = {"mode": config.mode, "features": features}
    else:
        codebook, made = _codebook_stage(run, maps, features, config, options)
        index_maps, indexed = _index_stage(run, maps, features, codebook, made, bool(options["progress"]))
        inputs = {"mode": config.mode, "index_maps": indexed.key}
        targets = LatentMaps(index_maps, codebook.codewords)
        if config.mode == "adc+sc":
            autoencoder, compressed = _autoencoder_stage(run, codebook, made, config, options)
            inputs["autoencoder"] = compressed.key
            with torch.no_grad():
                targets = LatentMaps(index_maps, autoencoder.encode(codebook.codewords))
    params, _ = _field_stage(run, scene, views, targets, inputs, config, device, options)
    return SemanticField(params.activated().detach(), codebook, autoencoder)


def _is_saved(field: SemanticField, path: Path) -> bool:
    """Whether this very field lies at `path` already, so that nothing there need be touched."""
    try:
        saved = SemanticField.load(path)
    except (OSError, ValueError):
        return False
    names = ("means", "quats", "scales", "opacities", "features")
    same = len(saved) == len(field) and saved.features.shape == field.features.shape and saved.method == field.method
    same = same and all(torch.equal(getattr(saved.gaussians, name), getattr(field.gaussians, name)) for name in names)
    return same and saved.info == json.loads(json.dumps(field.info))


def load_history(stage: Stage) -> list[dict[str, Any]]:
    """The history rows of a finished stage; none if it keeps no history."""
    path = stage.folder / "history.json"
    return list(read_json(path)) if path.is_file() else []
