"""The paper's schedule, whole: 30,000 steps with all densification and resets, on maps of the paper's size.

    python benchmarks/full_schedule.py ROOM FEATURES OUT [--rows decouple adc adc+sc] [--seeds 0 1 2] [--truth labels]
    python benchmarks/full_schedule.py ROOM FEATURES OUT --report      # the table of what is finished, nothing is fitted

FEATURES has a teacher's map of every training view. They are enlarged to 360x480 as they are read (bilinear; the paper's LSeg
maps are enlarged, too), so that nothing large is written. "Just decouple" and "ADC" train on the first 24 principal channels
of the unit features instead of on all: 512 channels would take days on a CPU. In few channels the mean of absolute
differences is larger (their ratio is printed with the share of the energy that is kept), and Gaussians would be split for it
that 512 channels leave alone: threshold of growth and rate of the features are multiplied by that ratio. "ADC + SC" sees all
channels. An hour or two a row on two cores; a killed run continues from its last 1,000 steps.

Labels of ADC and ADC + SC follow Sec. 3.4 (decode, quantise, look up), those of decouple are the text nearest to the feature.
Storage is that of Table 1 with the channels that were trained; "at D" with all of the teacher's channels, as published.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from statistics import mean
from typing import Any

import torch
from table1_rows import fitting_seconds
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from kfgs import FeatureFolder, Paper, fit, load_label_set, load_scene
from kfgs._files import read_json, write_json
from kfgs.cameras import from_bchw, resize_map, to_bchw
from kfgs.evaluation import evaluate_segmentation
from kfgs.labels import LabelSet
from kfgs.metrics import MIB, semantic_storage_bytes
from kfgs.pipeline import true_labels
from kfgs.quant import sample_grid
from kfgs.quant.maps import grid_slices

SIZE, CHANNELS, FREQUENT = (360, 480), 24, 10
STEPS = (500, 1_500, 2_500, 5_000, 10_000, 15_000, 30_000)
METHODS = {
    "decouple": Paper.paper(codebook=None, autoencoder=None),
    "adc": Paper.paper(autoencoder=None),
    "adc+sc": Paper.paper(),
}
ROWS = {"decouple": "just decouple", "adc": "decouple + ADC", "adc+sc": "decouple + ADC + SC"}


class Enlarged(Sequence[Tensor]):
    """Maps of a folder, enlarged as they are read, perhaps as unit features with fewer channels."""

    def __init__(self, maps: FeatureFolder, basis: Tensor | None = None) -> None:  # basis: [D, d]
        self._maps, self._basis, self.files, self.identity = maps, basis, maps.files, maps.identity
        self.stems = maps.stems
        self.shape = (*SIZE, maps.shape[2] if basis is None else basis.shape[1])

    def __len__(self) -> int:
        return len(self._maps)

    def __getitem__(self, i: int) -> Tensor:  # type: ignore[override]  # [360, 480, D]
        return resize_map(self._small(i), SIZE)

    def _small(self, i: int) -> Tensor:
        small = self._maps[i].float()
        return small if self._basis is None else normalize(small, dim=2) @ self._basis

    def grid(self, i: int, samples: int) -> Tensor:  # [n, D]
        """`quant.sample_grid(maps[i], samples=samples)`, enlarging nothing else."""
        axes = [torch.arange(n)[part] for n, part in zip(SIZE, grid_slices(*SIZE, samples), strict=True)]
        y, x = ((2 * axis + 1) / n - 1 for axis, n in zip(axes, SIZE, strict=True))
        places = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)[None]
        found = grid_sample(to_bchw(self._small(i)), places, padding_mode="border", align_corners=False)
        return from_bchw(found).flatten(0, 1)


def principal(maps: Sequence[Tensor]) -> tuple[Tensor, float]:  # [D, d]
    """The first principal directions of the unit features, without a mean, so that cosines are kept; and how many times
    larger two features' mean absolute difference is in these channels than in all.
    """
    rows = torch.cat([sample_grid(maps[i], samples=500) for i in range(len(maps))]).float()
    rows = normalize(rows[rows.norm(dim=1) > 0], dim=1)
    values, vectors = torch.linalg.eigh((rows.T @ rows).double())
    share, basis = values[-CHANNELS:].sum() / values.sum(), vectors[:, -CHANNELS:].flip(1).float()
    difference = rows - rows[torch.randperm(len(rows), generator=torch.Generator().manual_seed(0))]
    ratio = float((difference @ basis).abs().mean() / difference.abs().mean())
    print(f"{len(basis.T)} principal channels hold {share:.1%} of the features' energy, ratio {ratio:.2f}", flush=True)
    return basis, ratio


def in_few_channels(method: Paper, ratio: float) -> Paper:
    """The method with which few channels grow and learn as all would."""
    training = method.training
    assert training.densify is not None
    rates = replace(training.rates, features=ratio * training.rates.features)
    densify = replace(training.densify, gradient=ratio * training.densify.gradient)
    return replace(method, training=replace(training, rates=rates, densify=densify))


class Task:
    """A room with its teacher."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.args, self.scene = args, load_scene(args.scene).undistorted()
        self.maps = FeatureFolder(args.features).of(self.scene, "train")
        self.classes = load_label_set(args.scene / "classes.json", args.scene / "text.npy")
        self.truth = true_labels(self.scene, args.scene / args.truth, "test")

    @cached_property
    def few(self) -> tuple[Tensor, float]:
        """The principal directions of the training views' features, see `principal`."""
        return principal(self.maps)

    def run(self, row: str, seed: int) -> dict[str, Any]:
        """Fit a row, or continue it, and score it."""
        folder = self.args.out / f"{row}-{seed}"
        if (folder / "score.json").is_file():
            return dict(read_json(folder / "score.json"))
        method, basis = METHODS[row], None
        if row != "adc+sc":
            basis, ratio = self.few
            method = in_few_channels(method, ratio)
        maps = Enlarged(self.maps, basis)
        field = fit(self.scene, maps, method, folder=folder, seed=seed, report=print, progress=False)
        text = normalize(self.classes.embeddings.float(), dim=1)
        classes = self.classes if basis is None else LabelSet(self.classes.names, text @ basis)
        index = {self.scene.stem(i): i for i in self.scene.views("test")}
        report = evaluate_segmentation(
            lambda stem: field.paper.segment(self.scene.cameras[index[stem]], classes), self.truth, self.classes.names
        )
        counts = torch.bincount(torch.cat([labels[labels >= 0] for labels in self.truth.values()])).tolist()
        (history,) = folder.glob("stages/field-*/history.json")
        by_step = {entry["step"]: entry["count"] for entry in read_json(history)}
        result = {
            "row": row, "seed": seed, "accuracy": report.accuracy.value, "miou": report.miou.value,
            "iou": dict(zip(self.classes.names, report.iou.tolist(), strict=True)), "pixels": counts,
            "gaussians": len(field), "by_step": {step: by_step.get(step) for step in STEPS},
            "seconds": field.info["seconds"], "storage": field.storage(),
            "published_storage": field.storage() if basis is None else semantic_storage_bytes(len(field), self.maps.shape[2]),
        }  # fmt: skip
        write_json(folder / "score.json", result)
        return result


def frequent(result: dict[str, Any]) -> float:
    """The mean IoU over the ten classes with the most pixels."""
    names = list(result["iou"])
    order = sorted(range(len(result["pixels"])), key=lambda k: -result["pixels"][k])[:FREQUENT]
    return mean(result["iou"][names[k]] for k in order)


def table(results: Sequence[dict[str, Any]]) -> str:
    """Markdown, a line for each row and seed."""
    lines = [
        "| row, seed | mIoU | ten classes | accuracy | Gaussians | at steps "
        + ", ".join(f"{step:,}" for step in STEPS)
        + " | minutes (stages) | MiB (at D) |",
        "|" + "---|" * 8,
    ]
    for result in results:
        grown = ", ".join("-" if n is None else f"{n / 1_000:.1f}k" for n in result["by_step"].values())
        stages = ", ".join(f"{name} {seconds / 60:.0f}" for name, seconds in result["seconds"].items())
        lines.append(
            f"| {ROWS[result['row']]}, {result['seed']} | {100 * result['miou']:.1f} | {100 * frequent(result):.1f} | "
            f"{100 * result['accuracy']:.1f} | {result['gaussians'] / 1_000:.1f}k | {grown} | "
            f"{fitting_seconds(result['seconds']) / 60:.0f} ({stages}) | {result['storage'] / MIB:.1f} "
            f"({result['published_storage'] / MIB:.1f}) |"
        )
    return "\n".join(lines)


def main() -> None:
    """Fit, score, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("features", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--truth", default="labels_scored")
    parser.add_argument("--report", action="store_true", help="print what is finished")
    args = parser.parse_args()
    task, jobs = Task(args), [(row, seed) for row in args.rows for seed in args.seeds]
    if args.report:
        jobs = [(row, seed) for row, seed in jobs if (args.out / f"{row}-{seed}" / "score.json").is_file()]
    results = [task.run(row, seed) for row, seed in jobs]
    print("python benchmarks/full_schedule.py " + " ".join(sys.argv[1:]), table(results), sep="\n\n")


if __name__ == "__main__":
    main()
