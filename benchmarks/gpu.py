"""What to run on a day when a GPU is lent: right kernels first, then speed beside gsplat, then the main job. Eight minutes.

    python benchmarks/gpu.py --out FOLDER [--scene TOY] [--minutes 4]

Kernels: every case of `tests/cases_triton.py` against the reference engine in float64, shared out to processes. Speed:
`engines.py --device cuda` for at most `--minutes` (gsplat is compiled at first use; install it before, or it is left out).
The main job: colours of a toy room, and a field by both methods, scored on unseen views; `--scene` is a room that was made
elsewhere (`kfgs.toy`; it takes pycolmap). All that is found goes to gpu.json, and a line of it to the screen.

Without a GPU, `TRITON_INTERPRET=1 python benchmarks/gpu.py --cases "3 channels" --minutes 0` tries the script itself.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import cases_triton  # noqa: E402

from kfgs.evaluation import score_views  # noqa: E402
from kfgs.pipeline import ColorConfig, Paper, Uplift, fit, fit_color  # noqa: E402
from kfgs.pipeline.segment import score_scene, segment_scene, true_labels  # noqa: E402
from kfgs.scenes import FeatureFolder, load_scene  # noqa: E402
from kfgs.toy.room_folder import ToyConfig, make_toy_room  # noqa: E402

SHARES = 6  # processes: each compiles kernels for most of its time


def main() -> None:
    """Run the three parts; each writes what it finds before the next begins."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("gpu_benchmark"))
    parser.add_argument("--scene", type=Path, help="a toy room; without it, one is made")
    parser.add_argument("--minutes", type=float, default=4.0, help="for the speeds; 0 leaves them out")
    parser.add_argument("--cases", nargs="*", help="kernels' cases to run in this process, instead of all in several")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    report: dict[str, Any] = {"gpu": torch.cuda.get_device_name() if device == "cuda" else None}

    def save(part: str, found: Any) -> None:
        report[part] = found
        (args.out / "gpu.json").write_text(json.dumps(report, indent=1))
        print(f"{part}: {json.dumps(found)}", flush=True)

    save("kernels", check_kernels(device, args.cases))
    if args.minutes:
        command = [sys.executable, str(ROOT / "benchmarks/engines.py"), "--device", device, "--repeats", "7"]
        command += ["--out", str(args.out)]
        try:
            subprocess.run(command, timeout=60 * args.minutes, check=False)
        except subprocess.TimeoutExpired:
            print("speed: out of time; engines.md has what was measured")
    views = {"train_views": 20, "test_views": 5, "feature_size": (48, 64), "feature_dim": 96}
    if device == "cpu":
        views = {"train_views": 8, "test_views": 2, "size": (48, 64), "feature_size": (24, 32), "feature_dim": 16}
    small = ToyConfig(**views)
    scene = args.scene or make_toy_room(args.out / "scene", small)
    save("job", do_main_job(scene, args.out, device))


def check_kernels(device: str, cases: list[str] | None) -> dict[str, Any]:
    """How many cases were run, and what is wrong with those that failed."""
    if cases:
        facts = {name: cases_triton.run_case(cases_triton.CASES[name], device) for name in cases}
    else:
        script = str(ROOT / "tests/cases_triton.py")
        environment = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}
        running = [
            subprocess.Popen(
                [sys.executable, script, "run", device, f"{k}/{SHARES}"],
                stdout=subprocess.PIPE,
                text=True,
                env=environment,
            )
            for k in range(SHARES)
        ]
        facts = {}
        for process in running:
            facts |= json.loads(process.communicate()[0])
    faults = {name: cases_triton.find_faults(name, found) for name, found in facts.items()}
    return {"cases": len(facts), "faults": {name: wrong for name, wrong in faults.items() if wrong}}


def do_main_job(folder: Path, out: Path, device: str) -> dict[str, Any]:
    """Seconds and scores of colours and of a field by both methods, and how many labels of a view are equal on the CPU."""
    scene, maps = load_scene(folder), FeatureFolder(folder / "features")
    truth, found = true_labels(scene, folder / "labels", "test"), {}

    def timed(name: str, call: Any) -> Any:
        start = time.perf_counter()
        result = call()
        found[f"{name}: seconds"] = round(time.perf_counter() - start, 1)
        return result

    colors = timed("colours", lambda: fit_color(scene, out / "run", ColorConfig.quick()))
    found["colours"] = str(score_views(colors, scene))
    for name, method in {"uplift": Uplift(colors), "paper, codebook alone": Paper(autoencoder=None)}.items():
        field = timed(
            name, lambda method=method, name=name: fit(scene, maps.of(scene, "train"), method, folder=out / name)
        )
        labels = segment_scene(field, scene, field.classes, out / name / "seen", truth=truth)
        found[name] = str(score_scene(labels, truth, field.classes))
        there, camera = field.to(device), field.cameras[0]
        same = there.segment(camera.to(device)).cpu() == field.segment(camera)
        found[f"{name}: labels equal on the CPU"] = round(float(same.float().mean()), 5)
    return found


if __name__ == "__main__":
    main()
