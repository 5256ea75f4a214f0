"""The rows of Table 1: how each is fitted, and what is measured. One row in one process, so that its peak of memory is its own.

python benchmarks/table1_rows.py FOLDER    # reads FOLDER/request.json, writes FOLDER/row.json; `table1.py` calls it
"""

from __future__ import annotations

import re
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from baselines import cf3, feature_3dgs, langsplat, langsplatv2, legaussians, occam, plain_uplift
from baselines.common import FLOAT, Fitted, Task, sample_rows
from baselines.methods import LabelMaps
from devices import clock
from safetensors.torch import save_file

from kfgs._files import read_json, write_json
from kfgs._rows import unit_rows
from kfgs.cameras import Camera
from kfgs.evaluation import FieldMethod, LabelTruth, Method, TeacherMethod, View, label_view
from kfgs.evaluation.method import LabelRule
from kfgs.evaluation.segmentation import SegmentationReport, evaluate_segmentation
from kfgs.evaluation.teacher_agreement import TeacherAgreement
from kfgs.fields import Linear, SemanticField, Training
from kfgs.formats import read_splats
from kfgs.labels import LabelSet, load_label_set
from kfgs.pipeline import Paper, Uplift, fit, true_labels
from kfgs.pipeline.segment import save_label_map
from kfgs.scenes import FeatureFolder, Scene, load_scene

QUICK_STEPS = {"decouple": 350, "adc": 350, "adc+sc": 800, "own-adc+sc": 800}
FPS_VIEWS = 5
CODEC_ROWS = 20_000  # features that the codec's scores are taken over
REQUEST, RESULT = "request.json", "row.json"


@dataclass(frozen=True)
class Row:
    """A row of the table."""

    title: str
    paper: dict[str, Any] | None = None
    """The paper's figures: dim, miou, minutes, gaussians, mib, fps."""
    module: Any = None
    """Of a baseline."""
    options: tuple[Any, ...] = ()
    """Of the presets of its configuration."""
    mode: str | None = None
    """Of kfgs's `--method paper`; a row with neither is kfgs's default."""
    own: bool = False
    """Whether a row with a mode has kfgs's codebook and autoencoder instead of the paper's."""


def _paper(dim: str, miou: float, minutes: str, gaussians: float, mib: float, fps: float) -> dict[str, Any]:
    return {"dim": dim, "miou": miou, "minutes": minutes, "gaussians": 1_000 * gaussians, "mib": mib, "fps": fps}


ROWS = {
    "legaussians": Row("LEGaussians (frozen)", _paper("8", 32.0, "28", 571.0, 18.1, 77.66), legaussians),
    "langsplat": Row("LangSplat (one level)", _paper("3x3", 58.5, "10 + 5x3", 572.2, 20.7, 61.45 / 3), langsplat),
    "feature3dgs-128": Row(
        "Feature 3DGS, speed-up", _paper("128", 73.4, "99", 607.2, 296.5, 19.60), feature_3dgs, (128,)
    ),
    "feature3dgs-512": Row("Feature 3DGS", _paper("512", 73.9, "351", 602.2, 1175.2, 5.66), feature_3dgs),
    "decouple": Row("just decouple", _paper("512", 73.5, "263", 29.6, 59.4, 6.26), mode="decouple"),
    "adc": Row("decouple + ADC", _paper("512", 77.9, "220", 28.7, 57.6, 9.37), mode="adc"),
    "adc+sc": Row("decouple + ADC + SC", _paper("9", 76.6, "8", 110.5, 13.0, 36.08), mode="adc+sc"),
    "own-adc+sc": Row("ADC + SC, kfgs's codebook", mode="adc+sc", own=True),
    "kfgs": Row("**kfgs default**"),
    "langsplatv2": Row("LangSplatV2 (one level)", module=langsplatv2),
    "occam": Row("Occam's LGS", module=occam),
    "uplift": Row("plain uplift", module=plain_uplift),
    "cf3": Row("CF3", module=cf3),
}
"""Those that the paper has, in its order, then kfgs's default, then newer ones."""

CONFIGS = {
    legaussians: legaussians.LEGaussiansConfig, langsplat: langsplat.LangSplatConfig,
    feature_3dgs: feature_3dgs.Feature3DGSConfig, langsplatv2: langsplatv2.LangSplatV2Config,
    occam: occam.OccamConfig, plain_uplift: plain_uplift.PlainUpliftConfig, cf3: cf3.CF3Config,
}  # fmt: skip


def baseline_config(row: Row, preset: str) -> Any:
    """A baseline's configuration: `quick` is `short()`, `cpu` is `medium()`, `paper` is `published()`."""
    kind = CONFIGS[row.module]
    make = {"quick": kind.short, "cpu": kind.medium, "paper": kind.published}[preset]
    return make(*row.options)


def kfgs_config(row: Row, key: str, preset: str, steps: int | None) -> Uplift | Paper:
    """The configuration of one of kfgs's own rows.

    Codebook and autoencoder of the paper's rows are the paper's; only `--preset paper` has its schedule of the field, too.
    """
    if row.mode is None:
        return Uplift()  # nothing is trained
    method = Paper.grown() if row.own else Paper()
    training = Training() if preset == "paper" else Training.cpu()
    steps = QUICK_STEPS[key] if preset == "quick" and steps is None else steps
    method = replace(method, training=training if steps is None else training.with_steps(steps))
    if row.mode == "decouple":
        return replace(method, codebook=None, autoencoder=None)
    return replace(method, autoencoder=None) if row.mode == "adc" else method


def config_of(key: str, preset: str, steps: int | None, seed: int, device: str = "cpu") -> dict[str, Any]:
    """What decides a row, as JSON."""
    row = ROWS[key]
    if row.module:
        return asdict(baseline_config(row, preset))
    return kfgs_config(row, key, preset, steps).options() | {"seed": seed, "device": device}


@dataclass(frozen=True)
class Made:
    """A fitted row, before it is scored."""

    method: Method
    facts: dict[str, Any]
    nearest: Method
    """The same, labelled by the text nearest to each pixel's feature."""
    codec: Callable[[torch.Tensor], torch.Tensor] | None
    """See `Fitted.codec`."""
    on: Callable[[torch.device], tuple[Method, Callable[[Camera], Any]]]
    """The method on a device, and what renders its map there."""


class Room:
    """A scene with its teacher and its truth."""

    def __init__(self, folder: Path, features: Path, truth: str, every: int) -> None:
        self.scene: Scene = load_scene(folder).undistorted()
        self.classes: LabelSet = load_label_set(folder / "classes.json", folder / "text.npy")
        self.features = features
        self.maps = FeatureFolder(features).of(self.scene, "train")
        views = [View(self.scene.stem(i), self.scene.cameras[i]) for i in self.scene.views("test")]
        self.views = views[::every]
        found = true_labels(self.scene, folder / truth, "test")
        self.truth = LabelTruth(
            tuple(self.classes.names), {v.stem: found[v.stem] for v in self.views if v.stem in found}
        )

    @property
    def text(self) -> torch.Tensor:  # [K, D] unit rows
        """The classes."""
        return torch.nn.functional.normalize(self.classes.embeddings.float(), dim=1)

    def score(self, method: Method, nearest: Method) -> dict[str, Any]:
        """`kfgs-pooled/1` over the chosen views by three rules, and, if the teacher has maps of them, the agreement with it.

        Args:
            method: labels views by a rule of its own.
            nearest: the same method, by the nearest text of the rendered feature.
        """
        maps = LabelMaps(method, self.text)
        report = self.pooled(maps)
        scores = {"pooled": report.to_json(), "miou": report.miou.value, "accuracy": report.accuracy.value}
        scores["miou_nearest"] = scores["miou"] if nearest is method else self.pooled(nearest).miou.value
        scores["miou_votes"] = self.pooled(LabelMaps(method, self.text, votes=True)).miou.value
        try:
            taught = TeacherMethod(FeatureFolder(self.features).of(self.scene, "test"), align_corners=True)
        except FileNotFoundError:
            return scores
        agreement = TeacherAgreement(texts=tuple(self.classes.names), split=None)
        found = agreement.score(maps, taught, self.views, lambda _: self.text)
        return scores | {
            "teacher": found.to_json(),
            "teacher_accuracy": found["accuracy"],
            "teacher_iou7": found["mIoU"],
        }

    def pooled(self, method: Method) -> SegmentationReport:
        """`kfgs-pooled/1` of a method's labels over the chosen views."""
        views = {view.stem: view for view in self.views}
        return evaluate_segmentation(
            lambda stem: label_view(method, views[stem], self.text), self.truth.maps, self.truth.names
        )

    def codec_scores(self, codec: Callable[[torch.Tensor], torch.Tensor] | None, seed: int) -> dict[str, float]:
        """What compression alone costs: cosine with the teacher's features, and the share that keeps its best class."""
        if codec is None:
            return {}
        rows = sample_rows(self.maps, CODEC_ROWS, torch.Generator().manual_seed(seed)).float()
        with torch.no_grad():
            found = unit_rows(torch.cat([codec(part) for part in rows.split(8_192)]))
        cosine = (unit_rows(rows) * found).sum(dim=1).mean()
        same = (rows @ self.text.T).argmax(dim=1) == (found @ self.text.T).argmax(dim=1)
        return {"codec_cosine": float(cosine), "codec_same": float(same.double().mean())}


def fitting_seconds(stages: dict[str, float]) -> float:
    """The time that a method takes. Fused answers of the paper's fields are kfgs's own addition, and label no view."""
    return sum(seconds for name, seconds in stages.items() if name != "answers")


def frames_per_second(work: Callable[[Any], object], items: Sequence[Any]) -> float:
    """Median over the items of 1 / seconds, after one warm-up."""
    work(items[0])
    times = [clock(partial(work, item)) for item in items]
    return 1 / sorted(times)[len(times) // 2]


def peak_memory() -> int:
    """The highest resident memory of this process, bytes; 0 where the system does not say."""
    try:
        found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    except FileNotFoundError:
        return 0
    return 0 if found is None else 1024 * int(found[1])


def make_baseline(row: Row, room: Room, request: dict[str, Any], folder: Path) -> Made:
    """Fit a baseline on the frozen splat, and keep what it needs in a file."""
    cameras = [room.scene.cameras[i] for i in room.scene.views("train")]
    geometry = read_splats(request["splat"])
    task = Task(geometry, cameras, room.maps, seed=request["seed"])
    fitted: Fitted = row.module.fit(task, baseline_config(row, request["preset"]))
    file = folder / "semantics.safetensors"
    save_file({name: value.contiguous() for name, value in fitted.tensors.items()}, file)
    shape = 0 if fitted.own_geometry else FLOAT * 11 * len(fitted.method.gaussians)
    facts = {
        "dim": fitted.dim, "gaussians": len(fitted.method.gaussians), "storage": fitted.storage,
        "disk": file.stat().st_size + shape, "stages": fitted.seconds, "history": fitted.history,
    }  # fmt: skip

    def on(device: torch.device) -> tuple[Method, Callable[[Camera], Any]]:
        moved = fitted.method.to(device)
        return moved, moved.render

    return Made(fitted.method, facts, fitted.method, fitted.codec, on)


def make_kfgs(row: Row, room: Room, request: dict[str, Any], folder: Path) -> Made:
    """Fit one of kfgs's own rows."""
    method = kfgs_config(row, *(request[name] for name in ("row", "preset", "steps")))
    rule: LabelRule = "own" if row.mode is None or row.own else "paper"  # Sec. 3.4: decode, quantise, look up
    if isinstance(method, Uplift):
        method = replace(method, splat=request["splat"])
    shutil.rmtree(folder / "run", ignore_errors=True)  # stages of a killed run would count too few seconds
    field = fit(room.scene, room.maps, method, folder=folder / "run", seed=request["seed"], report=print)
    facts = {
        "dim": str(field.decoder.latent), "gaussians": len(field), "storage": field.storage(),
        "disk": (folder / "run" / "field.kfgs").stat().st_size, "stages": field.info["seconds"],
    }  # fmt: skip
    if row.mode is None:
        field.save(folder / "packed.kfgs", "small")
        facts["packed"] = (folder / "packed.kfgs").stat().st_size

    def on(device: torch.device) -> tuple[Method, Callable[[Camera], Any]]:
        moved = field.to(device)
        return FieldMethod(moved, rule=rule), moved.render

    return Made(FieldMethod(field, rule=rule), facts, FieldMethod(field, rule="nearest"), field_codec(field), on)


def field_codec(field: SemanticField) -> Callable[[torch.Tensor], torch.Tensor] | None:
    """What a field's compression alone makes of features; None if it stores them as they are."""
    decoder = field.decoder
    if isinstance(decoder, Linear):
        return lambda rows: decoder.decode(decoder.encode(rows))
    book, network = (getattr(decoder, name, None) for name in ("codebook", "autoencoder"))
    if book is None:
        return None
    if network is None:
        return lambda rows: book.codewords[book.quantize(rows)]
    decoded = network.decode(network.encode(book.codewords))
    return lambda rows: book.codewords[book.quantize(decoded)][book.quantize(rows)]


def views_on(views: Sequence[View], device: torch.device) -> list[View]:
    """Views whose cameras are on a device."""
    return [view._replace(camera=view.camera.to(device)) for view in views]


def run_row(folder: Path) -> dict[str, Any]:
    """Fit, score and measure what `folder/request.json` asks for."""
    request = read_json(folder / REQUEST)
    row, start = ROWS[request["row"]], time.perf_counter()
    room = Room(Path(request["scene"]), Path(request["features"]), request["truth"], request["every"])
    made = (make_baseline if row.module else make_kfgs)(row, room, request, folder)
    fit_peak = peak_memory()
    device = torch.device(request["device"])
    shown, text = views_on(room.views[:FPS_VIEWS], device), room.text.to(device)
    method, render = made.on(device)
    with torch.no_grad():
        fps = frames_per_second(lambda view: render(view.camera), shown)
        label_fps = frames_per_second(lambda view: label_view(method, view, text), shown)
    fitted = time.perf_counter()
    scores = room.score(made.method, made.nearest) | room.codec_scores(made.codec, request["seed"])
    middle = room.views[len(room.views) // 2]
    save_label_map(folder / "labels.png", label_view(made.method, middle, room.text))
    return {
        "request": request, "folder": folder.name,
        **made.facts, **scores, "fps_maps": fps, "fps_labels": label_fps, "peak_fit": fit_peak,
        "peak": peak_memory(), "views": len(room.truth.maps), "picture": middle.stem, "threads": torch.get_num_threads(),
        "scoring_seconds": time.perf_counter() - fitted, "wall_seconds": time.perf_counter() - start,
    }  # fmt: skip


if __name__ == "__main__":
    place = Path(sys.argv[1])
    write_json(place / RESULT, run_row(place))
