"""Views that come later: all fused at once, against half of them first and the others added.

    python benchmarks/incremental.py SCENE MAPS OUT --splat FILE [--truth labels_scored]

The first views are the first half of the camera's path, so that later ones show other parts of the scene. They are added in one
go, and in two. Prints wall and CPU seconds of each fit (the latter are steadier on a machine that others use), and the scores of
`benchmarks/fuse.py`: mIoU on unseen views, and the mean IoU of a query for each class over the Gaussians.
"""

from __future__ import annotations

import argparse
import shutil
import time
from dataclasses import replace
from pathlib import Path

from fuse import Room

from kfgs import FeatureFolder, FitConfig, fit_scene
from kfgs._files import write_json


def main() -> None:
    """Fit, score and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("maps", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--splat", type=Path, required=True)
    parser.add_argument("--truth", default="labels_scored")
    args = parser.parse_args()
    room, rows = Room(args.scene, args.maps, args.truth), []
    views = room.scene.views("train")
    half, most = len(views) // 2, 3 * len(views) // 4

    def fit(name: str, folder: str, count: int) -> None:
        scene = replace(room.scene, splits={**room.scene.splits, "train": views[:count]})
        maps = FeatureFolder(args.maps).of(scene, "train")
        wall, cpu = time.perf_counter(), time.process_time()
        made = fit_scene(scene, maps, args.out / folder, FitConfig.cpu(), splat=args.splat)
        spent = {"seconds": time.perf_counter() - wall, "CPU seconds": time.process_time() - cpu}
        if made.stages[-1].reused:
            raise SystemExit(f"{args.out}: expected a new folder, found results in it; name another")
        row = {"fit": name, "views": count, "Gaussians": len(made.field), "latents": made.field.channels, **spent}
        if count == len(views) or name == "first half":
            miou, accuracy = room.score(made.field)
            row |= {"mIoU": miou, "accuracy": accuracy, "queries": room.queries(made.field)}
        sums = made.stages[-1].folder / "sums.safetensors"
        rows.append({**row, "kept MB": sums.stat().st_size / 1e6})
        print(
            ", ".join(
                f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}"
                for key, value in rows[-1].items()
            ),
            flush=True,
        )

    fit("warm up", "warm", 4)
    fit("all at once", "whole", len(views))
    fit("first half", "one", half)
    shutil.copytree(args.out / "one", args.out / "two")
    fit("the other half added", "one", len(views))
    fit("a quarter added", "two", most)
    fit("and another quarter", "two", len(views))
    write_json(args.out / "incremental.json", rows)


if __name__ == "__main__":
    main()
