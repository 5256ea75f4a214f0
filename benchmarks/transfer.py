"""How long does it take to carry labels to another cloud, with lambda given and with lambda chosen?

    python benchmarks/transfer.py [--sources 100000] [--destinations 600000] [--repeats 3]

Two clouds along the walls of a room of 6 x 4 x 3, 1 cm thick, with labels in patches of half a unit. The least of some
repeats, beside scipy's bare k-d tree (no order, no ties, no counts) on the same points. On a busy machine, look at the
seconds of the cores: they do not count the wait. There is no GPU mode: labels are carried with a k-d tree, on the CPU.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from scipy.spatial import cKDTree

from kfgs.gaussians import Gaussians
from kfgs.labels import nearest_labels

SIZE = np.array([6.0, 4.0, 3.0])


def room(N: int, sigma: float, seed: int) -> Gaussians:
    """N flat-ish Gaussians along the walls."""
    rng = np.random.default_rng(seed)
    means, axis = rng.random((N, 3)) * SIZE, rng.integers(0, 3, N)
    means[np.arange(N), axis] = rng.integers(0, 2, N) * SIZE[axis]
    means += 0.01 * rng.standard_normal((N, 3))
    values = means, rng.standard_normal((N, 4)), sigma * (0.3 + rng.random((N, 3))), 0.05 + 0.9 * rng.random(N)
    return Gaussians(*(torch.from_numpy(value).float() for value in values))


def least(repeats: int, call: Callable[[], object]) -> tuple[float, float]:
    """Seconds by the clock and seconds of all cores together, each of the quickest of some calls."""
    clock, cores = [], []
    for _ in range(repeats):
        start = time.perf_counter(), time.process_time()
        call()
        clock.append(time.perf_counter() - start[0])
        cores.append(time.process_time() - start[1])
    return min(clock), min(cores)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sources", type=int, default=100_000)
    parser.add_argument("--destinations", type=int, default=600_000)
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args()
    src, dst = room(args.sources, 0.04, 0), room(args.destinations, 0.015, 1)
    patches = ((src.means + 0.25) * 2).floor().long()
    labels = (patches @ torch.tensor([1, 5, 7])) % 13
    distance = nearest_labels(src.means, labels, dst.means).distance
    points, targets = src.means.double().numpy(), dst.means.double().numpy()
    print(
        f"{args.sources:,} sources, {args.destinations:,} destinations, lambda {distance:.3g}; load {os.getloadavg()[0]:.1f}"
    )
    print(f"{'':34} {'seconds':>8} {'of cores':>9} {'labelled':>9}")
    for k in (1, 16):
        seconds = least(args.repeats, lambda k=k: cKDTree(points).query(targets, k=k, workers=-1))  # type: ignore[misc]
        print(f"{f'scipy alone, {k} neighbours':34} {seconds[0]:8.2f} {seconds[1]:9.2f}")
    rows = [("nearest, lambda chosen", {"distance": None}), ("nearest", {})]
    for name, options in rows:
        call = partial(nearest_labels, src.means, labels, dst.means, **{"distance": distance, **options})
        result = call()
        seconds = least(args.repeats, call)
        print(f"{name:34} {seconds[0]:8.2f} {seconds[1]:9.2f} {result.labelled / len(dst):9.1%}")


if __name__ == "__main__":
    main()
