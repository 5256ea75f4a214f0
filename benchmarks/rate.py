"""Size against quality of one field: packed with every precision, and as other formats carry it.

    python benchmarks/rate.py SCENE FIELD OUT [--every 3] [--truth labels_scored]

SCENE holds classes.json, text.npy and label pictures of its test views, of which every third is scored. OUT receives rate.md,
rate.json, rate.png and the files. PLY carries latents as columns. SPZ and SOG carry Gaussians and labels: once alone, a Gaussian
giving its vote to its label, and once with the latents beside, in half precision as a .safetensors file. Their colours are grey.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from safetensors.torch import load_file, save_file

from kfgs import SemanticField, load_label_set, load_scene, read_splats, write_splats
from kfgs._files import atomic_path, write_json
from kfgs.evaluation import FieldMethod, evaluate_segmentation
from kfgs.evaluation.method import View, label_view
from kfgs.fields import Linear
from kfgs.fields.packing import SMALL, Rounding
from kfgs.fields.store import SUFFIX
from kfgs.pipeline import true_labels

FACTORS = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 2, 4)
"""Of all errors of the precision "small": the curve. Angles stop at 30 degrees, shares at 1."""
LOADS = 7  # the quickest counts
MIB = 1 << 20
BLUE, RED = "#0072b2", "#d55e00"


@dataclass(frozen=True)
class Point:
    """One way to store the field."""

    name: str
    kind: str
    """"kfgs" (a named precision), "curve" (a multiple of it) or the format."""
    bytes: int
    miou: float
    accuracy: float
    same: float
    """Share of pixels with the label of the float32 field."""
    load_ms: float


class Room:
    """The views that are scored, and their truth."""

    def __init__(self, folder: Path, truth: str, every: int) -> None:
        scene = load_scene(folder).undistorted()
        self.classes = load_label_set(folder / "classes.json", folder / "text.npy")
        self.text = torch.nn.functional.normalize(self.classes.embeddings.float(), dim=1)
        views = [View(scene.stem(i), scene.cameras[i]) for i in scene.views("test")][::every]
        found = true_labels(scene, folder / truth, "test")
        self.views = {view.stem: view for view in views if view.stem in found}
        self.truth = {stem: found[stem] for stem in self.views}
        self.first: dict[str, torch.Tensor] = {}
        """The labels of the first field."""

    def score(self, field: SemanticField, text: torch.Tensor | None = None) -> dict[str, float]:
        """MIoU and accuracy in percent, and the share of labels that the first field has as well."""
        method, seen = FieldMethod(field), {}
        for stem, view in self.views.items():
            seen[stem] = label_view(method, view, self.text if text is None else text)
        self.first = self.first or seen
        found = evaluate_segmentation(lambda stem: seen[stem], self.truth, self.classes.names)
        same = torch.cat([(seen[stem] == self.first[stem]).flatten() for stem in seen]).double().mean()
        return {"miou": 100 * found.miou.value, "accuracy": 100 * found.accuracy.value, "same": 100 * float(same)}


def quickest(work: Callable[[], Any]) -> tuple[Any, float]:
    """What some work returns, and its least milliseconds."""
    times = []
    for _ in range(LOADS):
        start = time.perf_counter()
        found = work()
        times.append(1000 * (time.perf_counter() - start))
    return found, min(times)


def size_of(*paths: Path) -> int:
    """Bytes of files, and of the files in folders."""
    files = [file for path in paths for file in ([path] if path.is_file() else path.iterdir())]
    return sum(file.stat().st_size for file in files)


def scaled(factor: float) -> Rounding:
    """The precision "small" with all errors multiplied."""
    return Rounding(**{k: min(v * factor, 30.0 if k == "degrees" else 1.0) for k, v in asdict(SMALL).items()})


def packed(room: Room, field: SemanticField, out: Path) -> list[Point]:
    """Without loss, the named precisions, and the curve."""
    points = []
    asked: list[tuple[str, str, Any]] = [("lossless", "float32", None)]
    asked += [(name, "kfgs", name) for name in ("fine", "small", "tiny")]
    asked += [(f"small x {factor:g}", "curve", scaled(factor)) for factor in FACTORS]
    for name, kind, precision in asked:
        path = out / (name.replace(" ", "_") + SUFFIX)
        field.save(path, precision)
        back, took = quickest(lambda path=path: SemanticField.load(path))
        points.append(Point(name, kind, size_of(path), **room.score(back), load_ms=took))
    return points


def carried(room: Room, field: SemanticField, out: Path) -> list[Point]:
    """PLY, SPZ and SOG."""
    assert isinstance(field.decoder, Linear)
    basis = field.decoder.basis
    C = len(room.classes)
    labels = field.classify(room.classes).labels
    cloud = field.gaussians.replace(labels=labels, sh=torch.zeros(len(field), 1, 3))
    beside = out / "latents.safetensors"
    parts = {"latents": field.latents.half(), "basis": basis.half()}
    save_file({name: value.contiguous() for name, value in parts.items()}, beside)
    points = []
    for ending in ("ply", "spz", "sog"):
        path = out / f"field.{ending}"
        held = cloud if ending == "ply" else cloud.replace(features=None)
        written = write_splats(held.replace(names=tuple(room.classes.names)), path)
        splats, took = quickest(lambda path=path: read_splats(path))
        back, order = splats, written.order
        own = [one for one in written.paths if not one.name.endswith(".classes.json")]
        bare = out / "basis.safetensors"
        if ending == "ply":
            save_file({"basis": basis.contiguous()}, bare)
            found = room.score(SemanticField(back, field.decoder))
            points.append(Point("PLY, latents as columns", "ply", size_of(*own, bare), **found, load_ms=took))
            continue
        votes = torch.nn.functional.one_hot(back.labels.clamp_min(0), C).float() * (back.labels >= 0)[:, None]
        alone = SemanticField(back.replace(features=votes), Linear(torch.eye(C)))
        points.append(
            Point(f"{ending.upper()}, labels", ending, size_of(*own), **room.score(alone, torch.eye(C)), load_ms=took)
        )
        kept = load_file(beside)
        latents = kept["latents"].float() if order is None else kept["latents"].float()[order]
        whole = SemanticField(back.replace(features=latents), Linear(kept["basis"].float()))
        name = f"{ending.upper()} + float16 latents"
        points.append(Point(name, ending, size_of(*own, beside), **room.score(whole), load_ms=took))
    return points


def table(points: list[Point], count: int) -> str:
    """A Markdown table, by size."""
    lines = [
        "| stored as | MiB | bits a Gaussian | mIoU | accuracy | same labels | load, ms |",
        "|---|---|---|---|---|---|---|",
    ]
    for one in sorted(points, key=lambda point: point.bytes):
        lines.append(
            f"| {one.name} | {one.bytes / MIB:.3f} | {8 * one.bytes / count:.0f} | {one.miou:.2f} | {one.accuracy:.2f} | "
            f"{one.same:.2f} | {one.load_ms:.0f} |"
        )
    return "\n".join(lines)


def plot(path: Path, points: list[Point]) -> None:
    """mIoU, and labels that differ from those of the float32 field, against MiB: the packed field is a curve."""
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    own = sorted((p for p in points if p.kind in ("kfgs", "curve") and p.name != "lossless"), key=lambda p: p.bytes)
    left.plot([p.bytes / MIB for p in own], [p.miou for p in own], color=BLUE, label="one file of kfgs")
    right.plot([p.bytes / MIB for p in own], [100 - p.same for p in own], color=BLUE)
    for axes, value in ((left, lambda p: p.miou), (right, lambda p: 100 - p.same)):
        for one in (p for p in points if p.kind != "curve" and (axes is left or p.same < 100)):
            own_kind, size = one.kind in ("kfgs", "float32"), one.bytes / MIB
            axes.plot(size, value(one), "o" if own_kind else "s", color=BLUE if own_kind else RED)
            down, left_of = {"sog": -12, "float32": -12, "ply": -22}.get(one.kind, 5), size > 1
            axes.annotate(
                one.name, (size, value(one)), xytext=(-4 if left_of else 4, down), fontsize=7,
                textcoords="offset points", ha="right" if left_of else "left",
            )  # fmt: skip
        axes.set_xscale("log")
        axes.set_xticks([0.2, 0.3, 0.5, 1, 2, 4], ["0.2", "0.3", "0.5", "1", "2", "4"], minor=False)
        axes.minorticks_off()
        axes.set_xlabel("MiB")
        axes.grid(alpha=0.3)
    left.set_ylabel("mIoU of unseen views, %")
    right.set_ylabel("pixels with another label than float32, %")
    if any(p.same < 100 for p in points):
        right.set_yscale("log")
    left.legend(loc="lower right", fontsize=8)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=130)


def main() -> None:
    """Store, load, score, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("field", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--every", type=int, default=3)
    parser.add_argument("--truth", default="labels_scored")
    args = parser.parse_args()
    room, field = Room(args.scene, args.truth, args.every), SemanticField.load(args.field)
    if not isinstance(field.decoder, Linear):
        parser.error(f"FIELD: expected a fused field, got {field!r}; fit it with the default method")
    args.out.mkdir(parents=True, exist_ok=True)
    field = replace(field, classes=room.classes)
    points = packed(room, field, args.out) + carried(room, field, args.out)
    text = table(points, len(field))
    print(f"{len(field)} Gaussians, {field.decoder.latent} latents, {len(room.views)} views\n{text}")
    write_json(args.out / "rate.json", [asdict(point) for point in points])
    with atomic_path(args.out / "rate.md") as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")
    plot(args.out / "rate.png", points)


if __name__ == "__main__":
    main()
