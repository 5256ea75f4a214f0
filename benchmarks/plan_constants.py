"""Measure the constants of the planner (kfgs/pipeline/work.py): what each stage takes, in units of this machine's speed.

    python benchmarks/plan_constants.py [SCENE] [--parts features maps codebook autoencoder field]

Each measurement lies between two measurements of the speed of a matrix product in the same process, so that other work on
the machine counts in both; the fastest of a few repeats is taken. SCENE (a toy room when not given) is for the field.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import nnls

from kfgs.features import FeatureFolder
from kfgs.features.layouts import write_npy_map
from kfgs.fields import FieldConfig, GaussianParams, fit_field
from kfgs.pipeline.machine import measure_speed
from kfgs.pipeline.work import autoencoder_weights
from kfgs.quant import AutoencoderConfig, Codebook, CodebookConfig, fit_autoencoder, fit_codebook, quantize_maps
from kfgs.quant.sampling import farthest_points
from kfgs.scenes import load_scene
from kfgs.teachers.costs import lseg_flops
from kfgs.teachers.lseg.network import LSegConfig, LSegNetwork
from kfgs.toy.room_folder import ToyConfig, make_toy_room

CHANNELS = 512


def work_of(call: Callable[[], object], repeats: int = 3) -> float:
    """Seconds times speed, the least of some repeats."""
    found = []
    for _ in range(repeats):
        before = measure_speed(seconds=0.15).flops
        start = time.perf_counter()
        call()
        seconds = time.perf_counter() - start
        found.append(seconds * (before + measure_speed(seconds=0.15).flops) / 2)
    return min(found)


def report(name: str, value: float, unit: str) -> None:
    """A line per constant."""
    print(f"{name:<28s} {value:12.4g}  {unit}", flush=True)


def features() -> None:
    """One window through LSeg's network with random weights."""
    config = LSegConfig()
    network, window = LSegNetwork(config).eval(), torch.zeros(1, 3, config.window, config.window)
    with torch.no_grad():
        report("FEATURES_EFFICIENCY", lseg_flops(config) / work_of(lambda: network(window), 2), "share of the product")


def maps() -> None:
    """Writing a map, reading it back, and finding its codewords."""
    size = (180, 240)
    numbers = size[0] * size[1] * CHANNELS
    half = torch.randn(*size, CHANNELS).half()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.npy"
        report("WRITE_WORK", work_of(lambda: write_npy_map(path, half)) / numbers, "per number")
        stored = FeatureFolder(folder, ["a"])
        report("READ_WORK", work_of(lambda: stored[0]) / numbers, "per number")
    values = [half.float()]
    books = [Codebook(torch.randn(K, CHANNELS)) for K in (10, 100)]
    few, many = (work_of(lambda book=book: quantize_maps(values, book)) / numbers for book in books)
    report("QUANTIZE_CODEWORD_WORK", (many - few) / 90, "per number and codeword")
    report("QUANTIZE_WORK", few - (many - few) / 9, "per number")


def codebook() -> None:
    """Passes over maps that are in memory, and the first codewords."""
    values = [torch.randn(90, 120, CHANNELS) for _ in range(4)]
    rows = values[0].flatten(0, 1)
    report(
        "FARTHEST_EFFICIENCY",
        len(rows) ** 2 * CHANNELS / work_of(lambda: farthest_points(rows, 8)),
        "share of the product",
    )

    def passes(K: int) -> float:
        """Work per number of four passes: what five more epochs and one take, less what one epoch takes."""
        both = []
        for epochs in (1, 5):
            config = CodebookConfig.paper(
                initial=K, maximum=K, expand_below=-1, prune_above=1, epochs=epochs, step_every=2
            )
            both.append(work_of(lambda config=config: fit_codebook(values, config), 2))
        return (both[1] - both[0]) / (4 * 4 * rows.numel())

    few, many = passes(10), passes(100)
    report("LOOK_CODEWORD_WORK", (many - few) / 90, "per number and codeword")
    report("LOOK_WORK", few - (many - few) / 9, "per number")

    generator = torch.Generator().manual_seed(0)  # few directions, as splits pay in them until the book is full
    pool = torch.randn(128, 256, 8, generator=generator) @ torch.randn(8, CHANNELS, generator=generator)

    def growth(K: int) -> float:
        """Work per number of growing to K codewords."""
        return work_of(lambda: fit_codebook([pool], CodebookConfig(maximum=K, samples=pool.numel())), 2) / pool.numel()

    few, many = growth(55), growth(255)
    report("GROW_CODEWORD_WORK", (many - few) / 200, "per number and codeword")
    report("GROW_WORK", few - (many - few) * 55 / 200, "per number")


def autoencoder() -> None:
    """Steps on 20 and on 100 codewords."""
    found = []
    for K in (20, 100):
        config, book = AutoencoderConfig(steps=100, blends=0), Codebook(torch.randn(K, CHANNELS))
        work = work_of(lambda book=book, config=config: fit_autoencoder(book, config))
        found.append(work / 100 / autoencoder_weights(config, CHANNELS))
    report("AUTOENCODER_ROW_WORK", (found[1] - found[0]) / 80, "per weight, step and codeword")
    report("AUTOENCODER_WEIGHT_WORK", found[0] - (found[1] - found[0]) / 4, "per weight and step")


CASES = (  # channels, map, Gaussians per point, steps
    (9, (45, 60), 1, 40),
    (9, (90, 120), 1, 40),
    (9, (90, 120), 3, 30),
    (9, (180, 240), 1, 30),
    (9, (240, 320), 1, 20),
    (9, (240, 320), 4, 20),
    (32, (90, 120), 1, 20),
    (32, (180, 240), 3, 10),
    (128, (90, 120), 1, 10),
    (512, (90, 120), 1, 5),
    (512, (90, 120), 3, 5),
)


def field(path: str | None) -> None:
    """Steps of fields of several sizes, and the constants by least squares of the relative errors."""
    with tempfile.TemporaryDirectory() as folder:
        room = ToyConfig(train_views=8, test_views=2, size=(480, 640), feature_size=(30, 40), feature_dim=16)
        scene = load_scene(path or make_toy_room(Path(folder) / "room", room)).undistorted()
    views = scene.views("train")[:: max(1, len(scene.views("train")) // 6)]
    cameras, rows, generator = [scene.cameras[i] for i in views], [], torch.Generator().manual_seed(0)
    for channels, (h, w), times, steps in CASES:
        points = scene.points.repeat(times, 1)
        points = points + 0.005 * scene.extent * torch.randn(points.shape, generator=generator)
        start = GaussianParams.from_points(points, channels, generator=generator)
        targets = [torch.rand(h, w, channels, generator=generator) for _ in cameras]
        config = FieldConfig.cpu(steps=steps, densify_until=0)
        run = [start, cameras, targets, config]
        fit_field(*run[:3], FieldConfig.cpu(steps=2, densify_until=0), extent=scene.extent)  # compile
        work = work_of(lambda run=run: fit_field(*run, extent=scene.extent), 2) / steps
        pixels = min(2 * h, cameras[0].height) * min(2 * w, cameras[0].width)
        rows.append((1, pixels, pixels * channels, len(points), len(points) * channels, h * w * channels, work))
        print(f"  {channels} channels, {pixels} pixels, {len(points)} Gaussians: {work:.3g} a step", flush=True)
    *columns, measured = (np.array(column, float) for column in zip(*rows, strict=True))
    constants, _ = nnls(np.stack(columns, 1) / measured[:, None], np.ones(len(measured)))
    names = ("STEP_WORK", "STEP_PIXEL_WORK[0]", "STEP_PIXEL_WORK[1]", "STEP_GAUSSIAN_WORK[0]", "STEP_GAUSSIAN_WORK[1]")
    for name, value in zip((*names, "STEP_TARGET_WORK"), constants, strict=True):
        report(name, value, "")
    print("  foretold / measured:", np.round(np.stack(columns, 1) @ constants / measured, 2))


def main() -> None:
    """Measure the parts that are asked for, all by default."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="?")
    parts = {"features": features, "maps": maps, "codebook": codebook, "autoencoder": autoencoder}
    parser.add_argument("--parts", nargs="+", choices=[*parts, "field"], default=[*parts, "field"])
    args = parser.parse_args()
    speed = measure_speed()
    print(f"{speed.flops / 1e9:.0f} GFLOP/s on {speed.threads} threads")
    for name in args.parts:
        if name == "field":
            field(args.scene)
        else:
            parts[name]()


if __name__ == "__main__":
    main()
