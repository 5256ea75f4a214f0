"""What to run on a day when a GPU is lent: right kernels first, then speed beside gsplat, then the main job.

    bash benchmarks/gpu.sh OUT [--scene TOY]         all of it, in at most 8 minutes
    python benchmarks/gpu.py --out OUT --parts speed

Kernels: every case of `tests/cases_triton.py` against the reference engine in float64, forward and backward, shared out to
processes. Speed: a step, a frame, the best classes of each pixel, and uplift at 3, 9, 24, 64 and 512 channels, beside gsplat
where `import gsplat` works (it is compiled at first use; install it before); `engines.py --device cuda` measures more. The main
job: colours of a toy room, and fields by the default method and by the paper's, scored on unseen views. After each result
OUT/gpu.json has all numbers and OUT/gpu.md a table, those of earlier calls with the same OUT too: a part that is stopped
loses only what it was about. The job is timed alone: run the parts one after the other.

TOY is the room of `kfgs demo` (`DEMO/scene`). It is made if it is not given, which needs pycolmap. To carry less, leave out its
folder `features`: they are made again, the same. `CUDA_VISIBLE_DEVICES="" ... --parts job` with another OUT gives the CPU's
numbers for the same room. Without a GPU, `TRITON_INTERPRET=1 bash benchmarks/gpu.sh OUT --toy` tries the script itself; its
numbers mean nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import cases_triton  # noqa: E402
from engines import CHANNELS  # noqa: E402
from engines_machine import measure  # noqa: E402
from engines_runners import Case, calls, engine_names, missing, prepare  # noqa: E402

from kfgs._files import read_json, write_json  # noqa: E402
from kfgs.evaluation import score_views  # noqa: E402
from kfgs.pipeline import ColorConfig, Paper, Uplift, fit, fit_color  # noqa: E402
from kfgs.pipeline.segment import score_scene, segment_scene, true_labels  # noqa: E402
from kfgs.scenes import FeatureFolder, load_scene  # noqa: E402
from kfgs.toy.room_folder import ToyConfig, make_toy_room  # noqa: E402
from kfgs.toy.teacher import teacher_features  # noqa: E402

SHARES = 6  # processes: each compiles kernels for most of its time
PARTS = "kernels", "speed", "job"
TIMED = "step", "frame", "labels", "uplift"
CASES = [Case(110_000, channels, 480, 360) for channels in CHANNELS]
TOY_CASES, TOY_CHECKS = [Case(20, 24, 16, 8)], ["one channel"]
TOY_ROOM = ToyConfig(
    train_views=8, test_views=2, size=(48, 64), feature_size=(18, 24), surface_points=2_000, sparse_points=800
)
METHODS = {
    "uplift": Uplift,
    "grown": Paper.grown,
    "grown, codebook alone": partial(Paper.grown, autoencoder=None),
    "paper": Paper,
    "paper, its schedule": Paper.paper,
}


def main() -> None:
    """Run the parts; each writes what it finds before the next begins."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("gpu_benchmark"))
    parser.add_argument("--scene", type=Path, help="a toy room, for the job (default: it is made)")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--toy", action="store_true", help="a case, and sizes, that prove that the script runs")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS, help="of the job")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    name = (torch.cuda.get_device_name() if device == "cuda" else "cpu") + (", toy sizes" if args.toy else "")
    file = args.out / "gpu.json"
    report: dict[str, Any] = dict(read_json(file)) if file.exists() else {}
    if report.setdefault("device", name) != name:
        parser.error(
            f"--out: expected results of {name}, or none, got those of {report['device']}; give another folder"
        )

    def save(part: str, facts: Any) -> None:
        report[part] = facts
        write_json(file, report)
        (args.out / "gpu.md").write_text(write_table(report))
        print(f"{part}: {json.dumps(facts)}", flush=True)

    if "kernels" in args.parts:
        for facts in check_kernels(device, TOY_CHECKS if args.toy else None):
            save("kernels", facts)
    if "speed" in args.parts:
        time_engines(torch.device(device), args.toy, save)
    if "job" in args.parts:
        scene = args.scene or make_toy_room(args.out / "scene", TOY_ROOM if args.toy else ToyConfig())
        do_main_job(scene, args.out, device, args.methods, args.toy, save)
    if report.get("kernels", {}).get("faults"):
        raise SystemExit(1)


def time_engines(device: torch.device, toy: bool, save: Callable[[str, Any], None]) -> None:
    """Seconds of `TIMED` by engine and case; kfgs's GPU engine runs on the CPU in Triton's interpreter."""
    engines = engine_names(device) if device.type == "cuda" else ["kfgs triton"]
    seconds: dict[str, dict[str, dict[str, float]]] = {}
    for absent in missing(device):
        print(f"left out: {absent}")
    for case in TOY_CASES if toy else CASES:
        inputs = prepare(case, device)
        jobs = {
            (engine, name): call for engine in engines for name, call in calls(engine, inputs).items() if name in TIMED
        }
        for (engine, name), times in measure(jobs, 1 if toy else 9).items():
            seconds.setdefault(str(case), {}).setdefault(engine, {})[name] = times.median
        save("speed", seconds)


def write_table(report: dict[str, Any]) -> str:
    """What is known so far, in Markdown."""
    lines = [f"**{report['device']}**", ""]
    if "kernels" in report:
        kernels = report["kernels"]
        lines += [f"Kernels: {kernels['cases']} cases, wrong: {', '.join(kernels['faults']) or 'none'}.", ""]
    if "speed" in report:
        lines += ["| milliseconds | " + " | ".join(("engine", *TIMED)) + " |", "|---|---|" + "---|" * len(TIMED)]
        for case, engines in report["speed"].items():
            for engine, seconds in engines.items():
                cells = (f"{1e3 * seconds[name]:.2f}" if name in seconds else "-" for name in TIMED)
                lines.append(f"| {case} | {engine} | {' | '.join(cells)} |")
        lines.append("")
    jobs = {name: report[name] for name in ("colours", *METHODS) if name in report}
    lines += ["| job | seconds | Gaussians | score |", "|---|---|---|---|"] if jobs else []
    lines += [f"| {name} | {job['seconds']} | {job['Gaussians']:,} | {job['score']} |" for name, job in jobs.items()]
    return "\n".join(lines) + "\n"


def check_kernels(device: str, cases: list[str] | None) -> Iterator[dict[str, Any]]:
    """How many cases were run so far, and what is wrong with those that failed, after each process."""
    facts: dict[str, Any] = {}
    faults: dict[str, Any] = {}
    for k, found in enumerate([run_cases(device, cases)] if cases else run_shares(device)):
        facts |= found or {}
        faults |= {name: wrong for name in found or {} if (wrong := cases_triton.find_faults(name, facts[name]))}
        faults |= {} if found is not None else {f"process {k} of {SHARES}": "ended without a result"}
        yield {"cases": len(facts), "faults": faults}


def run_cases(device: str, cases: list[str]) -> dict[str, Any]:
    """What some cases gave, in this process."""
    return {name: cases_triton.run_case(cases_triton.CASES[name], device) for name in cases}


def run_shares(device: str) -> Iterator[dict[str, Any] | None]:
    """What each process gave for its share of all cases; None if it ended without a result."""
    command = [sys.executable, str(ROOT / "tests/cases_triton.py"), "run", device]
    environment = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}
    options: dict[str, Any] = {"stdout": subprocess.PIPE, "text": True, "env": environment}
    running = [subprocess.Popen([*command, f"{k}/{SHARES}"], **options) for k in range(SHARES)]
    for process in running:
        text = process.communicate()[0]
        yield json.loads(text) if process.returncode == 0 else None


def do_main_job(
    folder: Path, out: Path, device: str, methods: Iterable[str], toy: bool, save: Callable[[str, Any], None]
) -> None:
    """Seconds and scores of colours and of a field by each method, and how many labels of a view are equal on the CPU."""
    scene, maps = load_scene(folder), FeatureFolder(make_features(folder))
    truth, options = true_labels(scene, folder / "labels", "test"), ColorConfig.quick()
    if toy:
        options = replace(options, training=replace(options.training, steps=20))
    for earlier in ("run", *methods):  # a stage that is finished would be taken for a quick one
        shutil.rmtree(out / earlier, ignore_errors=True)
    start = time.perf_counter()
    colors = fit_color(scene, out / "run", options)
    seconds = round(time.perf_counter() - start, 1)
    save("colours", {"seconds": seconds, "score": str(score_views(colors, scene)), "Gaussians": len(colors)})
    for name in methods:
        method, start = Uplift(colors) if name == "uplift" else METHODS[name](), time.perf_counter()
        field = fit(scene, maps.of(scene, "train"), method, folder=out / name)
        facts = {
            "seconds": round(time.perf_counter() - start, 1),
            "stages": field.info["seconds"],
            "Gaussians": len(field),
        }
        labels = segment_scene(field, scene, field.classes, out / name / "seen", truth=truth, pictures=0)
        there, camera = field.to(device), field.cameras[0]
        same = there.segment(camera.to(device)).cpu() == field.segment(camera)
        facts["labels equal on the CPU"] = round(float(same.float().mean()), 5)
        save(name, facts | {"score": str(score_scene(labels, truth, field.classes).miou)})


def make_features(folder: Path) -> Path:
    """The teacher's maps of a toy room, made again where they were left out: as `make_toy_room` makes them."""
    config, embeddings = json.loads((folder / "toy.json").read_text())["config"], np.load(folder / "text.npy")
    (folder / "features").mkdir(exist_ok=True)
    for file in sorted((folder / "labels").glob("*.png")):
        made = folder / "features" / f"{file.stem}_fmap_CxHxW.pt"
        if not made.exists():
            rng = np.random.default_rng([config["seed"], 4, zlib.crc32(file.stem.encode())])
            labels, image = (np.asarray(Image.open(folder / of / file.name)) for of in ("labels", "images"))
            torch.save(torch.from_numpy(teacher_features(labels, image, embeddings, config["feature_size"], rng)), made)
    return folder / "features"


if __name__ == "__main__":
    main()
