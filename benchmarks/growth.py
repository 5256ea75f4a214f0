"""How does the cost grow with Gaussians, pixels, channels, classes and views?

    python benchmarks/growth.py OUT [--device cuda] [--threads 2] [--repeats 5] [--quick]

One size grows, the others stay: 30,000 Gaussians, 640x480 pixels, 16 channels, 18 classes (100,000 Gaussians where pixels grow).
Three calls are timed in turn: a feature map, a map with the gradients of all tensors, and a map of labels. For views it is the
whole `uplift_maps` of 5,000 Gaussians, merged to 2,000 and corrected, on maps of 30x40x32. Prints a table for each size, with the
exponent of growth since the row above: 1 is in proportion, 0 is free. Writes growth.json and growth.png.
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from devices import add_device, clock, device_name
from engines_room import room, view

from kfgs import Camera, Gaussians
from kfgs._files import atomic_path, write_json
from kfgs.fields import UpliftConfig, uplift_maps
from kfgs.splat import rasterize, rasterize_labels


@dataclass(frozen=True)
class Case:
    """One configuration of a rendering."""

    gaussians: int = 30_000
    size: tuple[int, int] = (640, 480)  # width, height
    channels: int = 16
    classes: int = 18


MANY = Case(gaussians=100_000)
AXES: dict[str, list[tuple[int, Case]]] = {
    "Gaussians": [(n, Case(gaussians=n)) for n in (10_000, 30_000, 100_000, 300_000, 1_000_000, 2_000_000)],
    "pixels": [
        (w * h, replace(MANY, size=(w, h)))
        for w, h in ((160, 120), (320, 240), (640, 480), (1280, 960), (1920, 1440), (3840, 2160))
    ],
    "channels": [(d, Case(channels=d)) for d in (1, 4, 16, 64, 256, 1024)],
    "classes": [(k, Case(classes=k)) for k in (1, 3, 10, 30, 100, 300, 1000)],
}
VIEWS = 10, 30, 100, 300, 1000, 2000
QUICK_AXES: dict[str, list[tuple[int, Case]]] = {
    name: [(size, replace(case, gaussians=min(case.gaussians, 500), size=(48, 32))) for size, case in cases[:2]]
    for name, cases in AXES.items()
}
CALLS = "feature map", "map and gradients", "labels"


def main() -> None:
    """Measure every size, print tables, write numbers and curves."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    add_device(parser)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="tiny cases, which only prove that it runs")
    args = parser.parse_args()
    if args.threads:
        torch.set_num_threads(args.threads)
    device, repeats = args.device, 1 if args.quick else args.repeats
    print(f"{device_name(device)}, {torch.get_num_threads()} threads, load {os.getloadavg()[0]:.1f} at the start")
    found: dict[str, list[dict[str, Any]]] = {}
    for name, cases in (QUICK_AXES if args.quick else AXES).items():
        found[name] = [{"size": size} | rendering(case, device, repeats) for size, case in cases]
        print(table(name, CALLS, found[name]), flush=True)
    uplift_seconds(2, device)  # loads what is compiled
    found["views"] = [{"size": n, "uplift": uplift_seconds(n, device)} for n in ((2, 4) if args.quick else VIEWS)]
    print(table("views", ("uplift",), found["views"]))
    args.out.mkdir(parents=True, exist_ok=True)
    write_json(args.out / "growth.json", found)
    draw(found, args.out / "growth.png")
    print(f"\nload {os.getloadavg()[0]:.1f} at the end; written: {args.out / 'growth.json'}, {args.out / 'growth.png'}")


def rendering(case: Case, device: torch.device, repeats: int) -> dict[str, float]:
    """Median seconds of the three calls."""
    cloud, camera = room(case.gaussians, case.channels).to(device), view(*case.size).to(device)
    scores = torch.randn(case.gaussians, case.classes, generator=torch.Generator().manual_seed(0)).to(device)
    labelled = cloud.replace(features=scores)
    jobs = (
        lambda: rasterize(cloud, camera),
        lambda: with_gradients(cloud, camera),
        lambda: rasterize_labels(labelled, camera),
    )
    seconds: list[list[float]] = [[] for _ in jobs]
    for turn in range(repeats + 1):  # the first round compiles and is not counted
        for job, kept in zip(jobs, seconds, strict=True):
            taken = clock(job)
            if turn > 0:
                kept.append(taken)
    return {name: statistics.median(kept) for name, kept in zip(CALLS, seconds, strict=True)}


def with_gradients(cloud: Gaussians, camera: Camera) -> None:
    """Render a map and differentiate its sum in every tensor of the cloud."""
    names = "means", "quats", "scales", "opacities", "features"
    tensors = {name: getattr(cloud, name).detach().requires_grad_() for name in names}
    rasterize(cloud.replace(**tensors), camera).map.sum().backward()


def uplift_seconds(views: int, device: torch.device) -> float:
    """Seconds of `uplift_maps` on so many views of a room of 5,000 Gaussians."""
    cloud, camera = room(5_000, 1).replace(features=None).to(device), view(160, 120).to(device)
    map = torch.randn(30, 40, 32, generator=torch.Generator().manual_seed(0)).to(device)
    config = UpliftConfig.field(max_gaussians=2_000)
    return clock(lambda: uplift_maps(cloud, [camera] * views, [map] * views, config))


def table(name: str, calls: Sequence[str], rows: list[dict[str, Any]]) -> str:
    """Milliseconds, and in brackets the exponent of growth since the row above."""
    lines = [f"\n| {name} | " + " | ".join(f"{call}, ms" for call in calls) + " |", "|---" * (1 + len(calls)) + "|"]
    for row, before in zip(rows, [None, *rows], strict=False):
        cells = [f"{1e3 * row[call]:,.1f}" + ("" if before is None else exponent(row, before, call)) for call in calls]
        lines.append(f"| {row['size']:,} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def exponent(row: dict[str, Any], before: dict[str, Any], call: str) -> str:
    """The slope between two rows on logarithmic axes."""
    return f" ({math.log(row[call] / before[call]) / math.log(row['size'] / before['size']):.1f})"


def draw(found: dict[str, list[dict[str, Any]]], file: Path) -> None:
    """One pair of logarithmic axes for each size that grows."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4 * len(found), 3.6), layout="constrained")
    for axes, (name, rows) in zip(figure.subplots(1, len(found), squeeze=False)[0], found.items(), strict=True):
        for call in rows[0].keys() - {"size"}:
            axes.loglog([row["size"] for row in rows], [1e3 * row[call] for row in rows], "o-", label=call)
        axes.set(xlabel=name, ylabel="ms")
        axes.grid(alpha=0.3, which="both")
        axes.legend(fontsize=8)
    with atomic_path(file) as path:
        figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
