"""What to run on a day when a GPU is lent: right kernels first, then speed beside gsplat, then the main job.

    python benchmarks/gpu.py --out FOLDER --scene TOY [--parts kernels speed job] [--minutes 4]

Kernels: every case of `tests/cases_triton.py` against the reference engine in float64, shared out to processes. Speed:
`engines.py --device cuda` for at most `--minutes` (gsplat is compiled at first use; install it before, or it is left out).
The main job: colours of a toy room, and fields by the default method and by the paper's, scored on unseen views. All that is
found goes to gpu.json, and a line of it to the screen. The job is timed alone: run its parts one after the other.

TOY is the room of `kfgs demo` (`DEMO/scene`), made where pycolmap is. To carry less, leave out its folder `features`: they are
made again, the same. `CUDA_VISIBLE_DEVICES="" ... --parts job` gives the CPU's numbers for the same room. Without a GPU,
`TRITON_INTERPRET=1 python benchmarks/gpu.py --parts kernels --cases "3 channels"` tries the script itself.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
import zlib
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import cases_triton  # noqa: E402

from kfgs.evaluation import score_views  # noqa: E402
from kfgs.pipeline import ColorConfig, Paper, Uplift, fit, fit_color  # noqa: E402
from kfgs.pipeline.segment import score_scene, segment_scene, true_labels  # noqa: E402
from kfgs.scenes import FeatureFolder, load_scene  # noqa: E402
from kfgs.toy.teacher import teacher_features  # noqa: E402

SHARES = 6  # processes: each compiles kernels for most of its time
PARTS = "kernels", "speed", "job"
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
    parser.add_argument("--scene", type=Path, help="a toy room, for the job")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--minutes", type=float, default=4.0, help="most minutes for the speeds")
    parser.add_argument("--cases", nargs="+", help="kernels' cases to run in this process, instead of all in several")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS, help="of the job")
    args = parser.parse_args()
    if "job" in args.parts and args.scene is None:
        parser.error(
            "--scene: expected a toy room for the job, got none; make one with `kfgs demo`, or leave out the job"
        )
    args.out.mkdir(parents=True, exist_ok=True)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    report: dict[str, Any] = {"device": torch.cuda.get_device_name() if device == "cuda" else "cpu"}

    def save(part: str, found: Any) -> None:
        report[part] = found
        (args.out / "gpu.json").write_text(json.dumps(report, indent=1))
        print(f"{part}: {json.dumps(found)}", flush=True)

    if "kernels" in args.parts:
        save("kernels", check_kernels(device, args.cases))
    if "speed" in args.parts:
        command = [sys.executable, str(ROOT / "benchmarks/engines.py"), "--device", device, "--repeats", "7"]
        command += ["--out", str(args.out)]
        try:
            subprocess.run(command, timeout=60 * args.minutes, check=False)
        except subprocess.TimeoutExpired:
            print("speed: out of time; engines.md has what was measured")
    if "job" in args.parts:
        do_main_job(args.scene, args.out, device, args.methods, save)


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


def do_main_job(folder: Path, out: Path, device: str, methods: Iterable[str], save: Callable[[str, Any], None]) -> None:
    """Seconds and scores of colours and of a field by each method, and how many labels of a view are equal on the CPU."""
    scene, maps = load_scene(folder), FeatureFolder(make_features(folder))
    truth, start = true_labels(scene, folder / "labels", "test"), time.perf_counter()
    colors = fit_color(scene, out / "run", ColorConfig.quick())
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
