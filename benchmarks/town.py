"""A toy town fitted whole and in blocks: mIoU on unseen views, agreement on the true surface near seams, memory per block.

    python benchmarks/town.py OUT [--rooms 3x3] [--blocks 16] [--steps 3000] [--seed 0] [--views 24]

Both fuse the same maps onto the same Gaussians: a colour splat trained on the whole town. Each block runs in a process of its
own, whose peak memory is told. "Near a seam": true surface points within 0.3 m of a border between two blocks.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

NEAR = 0.3  # metres


def main() -> None:
    """Run, and print a table."""
    from toy_town import make_toy_town

    from kfgs._files import read_json
    from kfgs.batch import join_blocks
    from kfgs.fields import SemanticField, UpliftConfig
    from kfgs.pipeline import ColorConfig, Uplift, fit_color
    from kfgs.scenes import load_scene
    from kfgs.scenes.blocks import Block
    from kfgs.toy.room_folder import ToyConfig

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--rooms", default="3x3")
    parser.add_argument("--blocks", type=int, default=16)
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--gaussians", type=int, default=6000, help="most semantic Gaussians per room")
    args = parser.parse_args()
    nx, ny = map(int, args.rooms.split("x"))
    town = args.out / f"town{args.seed}"
    room = ToyConfig(
        seed=args.seed, train_views=args.views, test_views=args.views // 4, size=(144, 192), feature_size=(54, 72),
        feature_dim=128, surface_points=20_000, sparse_points=6_000,
    )  # fmt: skip
    if not town.exists():
        make_toy_town(town, (nx, ny), room, progress=True)
    scene = load_scene(town)
    print(
        f"town {args.seed}: {nx * ny} rooms, {len(scene.views('train'))} training views, {len(scene.views('test'))} test views"
    )
    colors = ColorConfig.geometry()
    colors = replace(colors, training=colors.training.with_steps(args.steps).with_maximum(20_000 * nx * ny))
    fit_color(scene, args.out / f"run{args.seed}", colors, progress=True)
    splat = args.out / f"run{args.seed}" / "color.ply"
    total = args.gaussians * nx * ny
    method = Uplift(splat, UpliftConfig(max_gaussians=total))
    began = time.perf_counter()
    whole = _apart(_fit_whole, town, args.out / f"run{args.seed}", method)
    whole["seconds"] = time.perf_counter() - began
    _print("whole", SemanticField.load(args.out / f"run{args.seed}" / "field.kfgs"), scene, town, None, whole)
    folder = args.out / f"blocks{args.seed}"
    config = Uplift(splat=splat, uplift=UpliftConfig(max_gaussians=2 * total // args.blocks))
    began = time.perf_counter()
    took = _apart(_fit_in_blocks, town, folder, args.blocks, config)
    took["seconds"] = time.perf_counter() - began
    blocks = [Block(**block) for block in read_json(folder / "blocks.json")["blocks"]]
    _print(f"{args.blocks} blocks", join_blocks(folder), scene, town, blocks, took)
    _print("whole", SemanticField.load(args.out / f"run{args.seed}" / "field.kfgs"), scene, town, blocks, whole)


def _fit_whole(town: Path, run: Path, method: Any) -> None:
    from kfgs.pipeline import fit
    from kfgs.scenes import FeatureFolder, load_scene

    scene = load_scene(town)
    fit(scene, FeatureFolder(town / "features").of(scene, "train"), method, folder=run)


def _fit_in_blocks(town: Path, folder: Path, count: int, method: Any) -> None:
    from kfgs.batch import fit_blocks

    fit_blocks(town, folder, count, replace(method, splat=None), splat=method.splat)


def _apart(do: Any, *args: Any) -> dict[str, Any]:
    """Run in a fresh process; its peak memory."""
    context = multiprocessing.get_context("spawn")
    with context.Pool(1) as pool:
        return dict(pool.apply(_measured, (do, args)))


def _measured(do: Any, args: tuple[Any, ...]) -> dict[str, Any]:
    do(*args)
    # not ru_maxrss, which a process inherits from the one that started it
    peak = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return {"peak_mib": round(int(peak.split()[1]) / 1024)}


def _print(name: str, field: Any, scene: Any, town: Path, blocks: Any, facts: dict[str, Any]) -> None:
    """One row: scores of a field."""
    from kfgs.evaluation import evaluate_segmentation, find_points
    from kfgs.evaluation.surface import score_surface
    from kfgs.labels import load_label_set
    from kfgs.pipeline import true_labels

    classes = load_label_set(town / "classes.json", town / "text.npy")
    truth = true_labels(scene, town / "labels", "test")
    cameras = {scene.stem(i): scene.cameras[i] for i in scene.views("test")}
    report = evaluate_segmentation(lambda stem: field.segment(cameras[stem], classes), truth, classes.names)
    true = find_points(town)
    points, labels = true.points, true.labels
    labelled = field.label(classes)
    row = {"miou": round(float(report.miou.value), 4), "gaussians": len(field), **facts}
    for what, rows in _places(points, blocks).items():
        row[what] = round(score_surface(labelled.means, labelled.labels, points[rows], labels[rows]).value, 4)
    print(name, json.dumps(row))


def _places(points: Any, blocks: Any) -> dict[str, Any]:
    means = points.numpy()
    if blocks is None:
        return {"surface": np.ones(len(means), bool)}
    near = np.zeros(len(means), bool)
    for block in blocks:
        low, high = np.array(block.core)
        inside = ((means >= low - NEAR) & (means < high + NEAR)).all(1)
        border = (np.abs(means - low) < NEAR).any(1) | (np.abs(means - high) < NEAR).any(1)
        near |= inside & border
    return {"surface": np.ones(len(means), bool), "near_seams": near, "elsewhere": ~near}


if __name__ == "__main__":
    main()
