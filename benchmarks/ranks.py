"""Speed of several processes on one field against one process, each with one thread.

    OMP_NUM_THREADS=1 torchrun --standalone --nproc-per-node 2 benchmarks/ranks.py OUT [--rounds 5]

OUT receives a toy room (16 views of 240x320, maps of 60x80x128) and ranks.json. The same processes do the same work in turns:
the first alone while the others wait, then all together; the quickest round of each counts, because other programs disturb.
Beside the time, the processor time of the busiest process is measured: what the time would be if no other program ran and no
process waited for another. Both results are compared bit by bit.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from kfgs import load_scene
from kfgs._files import write_json
from kfgs._ranks import first, in_order, once, place
from kfgs.features import FeatureFolder
from kfgs.fields import ColorLoss, FieldConfig, GaussianParams, UpliftConfig, fit_field, uplift_maps
from kfgs.pipeline import together
from kfgs.pipeline.stages import digest_tensors
from kfgs.toy.room_folder import ToyConfig, make_toy_room

ROOM = ToyConfig(
    train_views=16,
    test_views=1,
    size=(240, 320),
    feature_size=(60, 80),
    feature_dim=128,
    surface_points=40_000,
    sparse_points=20_000,
)
STEPS = 24


def works(room: Path, views: int) -> dict[str, Callable[[], str]]:
    """Uplift and training, as functions that return a digest of their result."""
    scene = load_scene(room)
    chosen = scene.views("train")
    cameras = [scene.cameras[i] for i in chosen]
    folder, photos = FeatureFolder(room / "features").of(scene, "train"), [scene.image(i) for i in chosen]
    maps = [folder[i].float() for i in range(len(folder))]
    start = GaussianParams.from_points(scene.points, colors=scene.colors, sh_degree=1)
    config = FieldConfig(steps=STEPS, views_per_step=views, densify_until=0, reset_every=0, sh_degree_every=0)

    def uplift() -> str:
        found = uplift_maps(start.activated().detach(), cameras, maps, UpliftConfig())
        return digest_tensors(found.gaussians.features, found.latents.basis)

    def train() -> str:
        fit = fit_field(start, cameras, photos, config, loss=ColorLoss(0.2))
        return digest_tensors(*fit.params.to_tensors().values())

    return {"uplift": uplift, "training": train}


def timed(work: Callable[[], str]) -> list[Any]:
    """Seconds, seconds of the processor, and what the work returned."""
    started, busy = time.perf_counter(), time.process_time()
    found = work()
    return [time.perf_counter() - started, time.process_time() - busy, found]


def busiest(seconds: float) -> float:
    """The most seconds of any process."""
    return max(
        float(one["seconds"])
        for one in in_order(range(place()[1]), lambda _: {"seconds": torch.tensor(seconds, dtype=torch.float64)})
    )


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    size, rows = place()[1], {}
    with together():
        room = args.out / "room"
        once(lambda: None if (room / "toy.json").is_file() else str(make_toy_room(room, ROOM)))
        for name, work in works(room, size).items():
            alone, shared = list[list[float]](), list[list[float]]()
            for _ in range(args.rounds):
                seconds, busy, expected = once(lambda work=work: timed(work))
                alone.append([seconds, busy])
                seconds, busy, found = timed(work)
                shared.append([seconds, busiest(busy)])
                assert found == expected, f"{name}: the results differ"
            rows[name] = {"alone": alone, "together": shared}
        if first():
            threads = torch.get_num_threads()
            print(f"{size} processes, {threads} thread(s) each")
            for name, row in rows.items():
                for kind, which in (("seconds", 0), ("processor seconds of the busiest", 1)):
                    one, several = (min(entry[which] for entry in row[way]) for way in ("alone", "together"))
                    print(f"{name}, {kind}: {one:.2f} by one, {several:.2f} by {size}: {one / several:.2f} times")
            write_json(args.out / "ranks.json", {"processes": size, "threads": threads, "seconds": rows})


if __name__ == "__main__":
    main()
