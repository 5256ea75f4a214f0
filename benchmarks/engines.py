"""Every engine of kfgs and the peers that can be had, side by side in one run, on the CPU or on a GPU.

    python benchmarks/engines.py [--quick] [--out FOLDER] [--threads 1 2] [--repeats 9] [--slowest 20] [--device cuda]

writes engines.md (tables), engines.json (all numbers) and curves as PNG, in about an hour on two cores. In each
configuration all engines get the same arrays and the same lists of tiles, and are timed in turn, round after round; the
tables give medians, with the least in brackets. Growth is measured along three axes: N at 480x360x9, pixels at N = 110k
x9, channels at 30k 640x480 and 110k 480x360. A call that would take longer than `--slowest` seconds is left out, and the
table says so.
`--quick` checks that all of it works, in about a minute; its numbers mean little.

With `--device cuda` it is kfgs's Triton engine beside gsplat, if `import gsplat` works, in larger configurations and with 3, 9,
24, 64 and 512 channels. gsplat has no compositing by itself: compare frames and steps. What is missing is named.

**Operations**, for the share of the machine's peak: on a pair (pixel, Gaussian) that is composited, alpha takes 24
(two differences, seven for the power, twelve for the exponential, three for opacity, clamp and threshold), transmittance
and weight 4, and each channel 2; the backward pass does the same again, 2 more for each channel, and 17 for the slope of
log(alpha), what is left behind, and six moments. Work on pixels that a Gaussian does not reach counts as nothing. The
peak is that of torch's float32 matrix product with as many threads, multiply and add counted as two.

**Peers** (looked up in the package index in November 2026, Python 3.11, Linux x86-64):

- gsplat 1.5.3: a wheel of CUDA sources, compiled with nvcc at first use; its torch fallback needs nerfacc and two CUDA
  kernels to list and composite. Nothing runs on a CPU; on a GPU it is measured;
- taichi-splatting 0.13.0 (with taichi 1.7.4): installs, but its rasteriser is written with shared memory and warp votes,
  which taichi has for CUDA only; only its projection and harmonics run on a CPU;
- warp-lang 1.19.0: installs and compiles for CPUs, but brings no rasteriser;
- gaussian-splatting 2.11.0: wraps the CUDA rasterisers;
- splatkit 0.1.0: trains through gsplat; nerfview 0.1.3: a viewer, without a rasteriser; `brush` in the index is a laboratory's
  logger, and the rasteriser of that name is a program in Rust without a package;
- torch-splatting, opensplat, diff-gaussian-rasterization: not in the index. OpenSplat's CPU rasteriser needs a C++
  compiler and torch-splatting a checkout.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as kfgs sets it; before torch starts its threads

import torch
from devices import CPU, add_device
from engines_machine import describe, measure, measure_peak, peak_memory
from engines_report import write_curves, write_tables
from engines_runners import Calls, Case, Inputs, calls, count_pairs, engine_names, missing, prepare
from engines_step import kfgs_step

SIZES = (320, 240), (480, 360), (640, 480), (1280, 960)
SLICES = {
    "Gaussians": [Case(n, 9, 480, 360) for n in (10_000, 30_000, 110_000, 500_000)],
    "pixels": [Case(110_000, 9, *size) for size in SIZES],
    "channels, N=30,000": [Case(30_000, c, 640, 480) for c in (3, 9, 64, 512)],
    "channels, N=110,000": [Case(110_000, c, 480, 360) for c in (3, 9, 64, 512)],
}
QUICK_SLICES = {
    "Gaussians": [Case(n, 9, 160, 120) for n in (1_000, 3_000, 10_000)],
    "pixels": [Case(3_000, 9, *size) for size in ((80, 60), (160, 120), (240, 180))],
    "channels, N=3,000": [Case(3_000, c, 160, 120) for c in (3, 9, 64)],
}
CHANNELS = 3, 9, 24, 64, 512
GPU_SLICES = {
    "Gaussians": [Case(n, 9, 640, 480) for n in (30_000, 110_000, 500_000, 2_000_000)],
    "pixels": [Case(500_000, 9, *size) for size in SIZES],
    "channels, N=110,000": [Case(110_000, c, 480, 360) for c in CHANNELS],
    "channels, N=500,000": [Case(500_000, c, 640, 480) for c in CHANNELS],
}
QUICK_GPU_SLICES = QUICK_SLICES | {"channels, N=3,000": [Case(3_000, c, 160, 120) for c in CHANNELS]}
STEP, QUICK_STEP = Case(110_000, 9, 480, 360), Case(10_000, 9, 240, 180)


def main() -> None:
    """Measure, and write after each configuration what is known so far."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="tiny configurations, about a minute")
    parser.add_argument("--out", type=Path, default=Path("engines_benchmark"), help="folder for tables and curves")
    parser.add_argument("--threads", type=int, nargs="+", help="thread counts (default: 1 and all; quick: all)")
    parser.add_argument("--repeats", type=int, help="rounds per configuration (default 9; quick 3)")
    parser.add_argument("--slowest", type=float, default=20.0, help="seconds above which an engine is left out")
    add_device(parser)
    parser.add_argument("--memory-of", nargs=5, metavar=("ENGINE", "N", "C", "W", "H"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    device, gpu = args.device, args.device.type == "cuda"
    if args.memory_of:
        engine, *numbers = args.memory_of
        print(json.dumps(memory(engine, Case(*map(int, numbers)), device)))
        return
    cores = os.cpu_count() or 1
    threads = args.threads or ([cores] if args.quick or gpu else sorted({1, cores}))
    repeats = args.repeats or (3 if args.quick else 9)
    slices = (QUICK_GPU_SLICES if gpu else QUICK_SLICES) if args.quick else GPU_SLICES if gpu else SLICES
    absent = missing(device)
    for line in absent:
        print(f"left out: {line}")
    if not engine_names(device):
        parser.error(f"--device: expected one that an engine runs on, got {device}; missing: {'; '.join(absent)}")
    args.out.mkdir(parents=True, exist_ok=True)

    report: dict[str, Any] = {"machine": describe(device), "quick": args.quick, "slices": {}, "peak": {}, "cases": []}
    report |= {"steps": [], "memory": [], "repeats": repeats, "missing": absent}
    report["slices"] = {name: [list(case) for case in cases] for name, cases in slices.items()}
    for count in threads:
        torch.set_num_threads(count)
        report["peak"][str(count)] = measure_peak(device)._asdict()
        report["steps"].append(time_step(QUICK_STEP if args.quick else STEP, count, repeats, device))
        save(report, args.out)
        rates: dict[str, float] = {}
        for case in dict.fromkeys(case for cases in slices.values() for case in cases):
            report["cases"].append(time_case(case, count, repeats, args.slowest, rates, device))
            save(report, args.out)
    channels = next(cases for name, cases in slices.items() if name.startswith("channels"))
    probed = [slices["Gaussians"][1]] if args.quick else [*slices["Gaussians"], *channels]
    for entry in report["cases"]:
        if entry["threads"] == threads[-1] and Case(*entry["case"]) in probed:
            report["memory"] += [probe_memory(engine, Case(*entry["case"]), device) for engine in entry["seconds"]]
            save(report, args.out)
    write_curves(report, args.out)
    print(f"written: {', '.join(str(path) for path in sorted(args.out.glob('engines*')))}")


def time_case(
    case: Case, threads: int, repeats: int, slowest: float, rates: dict[str, float], device: torch.device = CPU
) -> dict[str, Any]:
    """Time all engines on one case. `rates` is seconds per unit of work so far, by which to leave out what is too slow."""
    inputs = prepare(case, device)
    pairs = count_pairs(inputs)
    work = pairs.listed * (20 + case.channels)
    entry: dict[str, Any] = {"case": list(case), "threads": threads, "pairs": pairs._asdict(), "left_out": {}}
    entry |= {"seconds": {}, "difference": {}, "frame_difference": {}}
    jobs, maps = {}, None
    for engine in engine_names(device):
        expected = rates.get(engine, 0) * work
        if expected > slowest:
            entry["left_out"][engine] = f"about {expected:.0f} s"
            continue
        jobs[engine] = calls(engine, inputs)
        alone = "forward" in jobs[engine]  # it composites the given lists; else it makes its own
        found = jobs[engine]["forward" if alone else "frame"]()
        maps = found if maps is None else maps
        off = (found - maps).abs()  # from the first engine's
        entry["difference" if alone else "frame_difference"][engine] = float(off.max() if alone else off.mean())
        del found, off
    del maps
    times = measure({(e, name): call for e, made in jobs.items() for name, call in made.items()}, repeats)
    for (engine, name), seconds in times.items():
        entry["seconds"].setdefault(engine, {})[name] = seconds._asdict()
    for engine, seconds in entry["seconds"].items():
        rates[engine] = max(times["median"] for times in seconds.values()) / work
    print(f"{case}, {threads} threads: " + ", ".join(_brief(e, s) for e, s in entry["seconds"].items()), flush=True)
    jobs.clear()
    gc.collect()
    return entry


def _brief(engine: str, seconds: dict[str, dict[str, float]]) -> str:
    return f"{engine} " + "/".join(f"{1e3 * times['median']:.1f}" for times in seconds.values())


def time_step(case: Case, threads: int, repeats: int, device: torch.device = CPU) -> dict[str, Any]:
    """Time the whole training step of every engine, and the stages of the fast ones."""
    inputs: Inputs = prepare(case, device)
    whole: dict[Any, Any] = {}
    stages: dict[Any, Any] = {}
    for engine in engine_names(device):
        if not engine.startswith("kfgs "):
            continue
        step, parts = kfgs_step(engine.removeprefix("kfgs "), inputs)
        whole[engine] = step["step"]
        if engine != "kfgs reference":
            stages |= {(engine, name): call for name, call in parts.items()}
    entry: dict[str, Any] = {"case": list(case), "threads": threads, "step": {}, "stages": {}}
    for engine, times in measure(whole, 2 * repeats + 1).items():
        entry["step"][engine] = times._asdict()
    for (engine, name), times in measure(stages, repeats, slow=float("inf")).items():
        entry["stages"].setdefault(engine, {})[name] = times._asdict()
    brief = ", ".join(f"{engine} {1e3 * times['median']:.1f} ms" for engine, times in entry["step"].items())
    print(f"training step, {case}, {threads} threads: {brief}", flush=True)
    return entry


def memory(engine: str, case: Case, device: torch.device) -> dict[str, Any]:
    """Bytes that one forward and backward pass needs, beyond its input; kernels are compiled before.

    On the CPU it is compositing alone. On a GPU it is the whole step, which gsplat has too.
    """
    parts = ("step",) if device.type == "cuda" else ("forward", "backward")

    def run(jobs: Calls) -> None:
        for part in parts:
            jobs[part]()

    run(calls(engine, prepare(Case(200, case.channels, 32, 32), device)))
    job = calls(engine, prepare(case, device))
    gc.collect()
    return {"engine": engine, "case": list(case), "bytes": peak_memory(lambda: run(job), device)}


def probe_memory(engine: str, case: Case, device: torch.device) -> dict[str, Any]:
    """`memory` in a process of its own."""
    command = [sys.executable, __file__, "--device", str(device), "--memory-of", engine, *map(str, case)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    entry = json.loads(done.stdout.splitlines()[-1])
    print(f"memory, {case}: {engine} {entry['bytes'] / 2**20:.0f} MiB", flush=True)
    return entry


def save(report: dict[str, Any], out: Path) -> None:
    """Write the numbers and the tables."""
    (out / "engines.json").write_text(json.dumps(report, indent=1))
    (out / "engines.md").write_text(write_tables(report))


if __name__ == "__main__":
    main()
