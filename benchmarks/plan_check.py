"""Does a run take what the planner says? Time, memory and disk of each stage, planned and measured.

    python benchmarks/plan_check.py [SCENE] [--features FOLDER] [--methods fuse paper] [--device cuda]

SCENE has maps in SCENE/features, or in --features; the default is a toy room. The stated factor is two for the time of all
stages together. The run is in a process of its own, whose highest resident memory is what Linux says (VmHWM).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import torch
from devices import CPU, add_device

from kfgs.features import FeatureFolder
from kfgs.pipeline import FitConfig, fit_scene, plan_scene
from kfgs.pipeline.trial import PeakMemory
from kfgs.scenes import load_scene
from kfgs.toy.room_folder import make_toy_room


def fit(scene_folder: Path, features: Path, method: str, run: Path, device: torch.device = CPU) -> None:
    """Fit, and print what it took as JSON."""
    scene = load_scene(scene_folder)
    maps = FeatureFolder(features, [scene.stem(i) for i in scene.views("train")])
    with PeakMemory() as memory:
        made = fit_scene(scene.undistorted(), maps, run, FitConfig.cpu(method=method, device=str(device)))
    written = sum(file.stat().st_size for file in run.rglob("*") if file.is_file())
    seconds = {stage.name.replace("_", " "): stage.seconds for stage in made.stages}
    print(json.dumps({"seconds": seconds, "peak": memory.bytes, "written": written}))


def compare(scene: Path, features: Path, method: str, run: Path, device: torch.device = CPU) -> None:
    """Plan, run, and print both."""
    config = FitConfig.cpu(method=method, device=str(device))
    plan = plan_scene(load_scene(scene), config=config, features=features, run=run)
    command = [sys.executable, __file__, str(scene), "--features", str(features), "--fit", method, str(run)]
    command += ["--device", str(device)]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    took = json.loads(said.splitlines()[-1])
    print(f"\n{plan.title}\n\n| stage | planned | measured |\n|---|---|---|")
    for stage in plan.stages:
        print(f"| {stage.name} | {stage.seconds or 0:.1f} s | {took['seconds'][stage.name]:.1f} s |")
    total = sum(took["seconds"].values())
    print(f"| in all | {plan.seconds or 0:.1f} s | {total:.1f} s (factor {(plan.seconds or 0) / total:.2f}) |")
    print(f"| peak memory | {(plan.peak_bytes or 0) / 1e9:.2f} GB | {(took['peak'] or 0) / 1e9:.2f} GB |")
    print(f"| disk in the end | {(plan.kept_bytes or 0) / 1e6:.1f} MB | {took['written'] / 1e6:.1f} MB |", flush=True)


def main() -> None:
    """Compare the methods that are asked for, both by default."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="?", type=Path)
    parser.add_argument("--features", type=Path)
    parser.add_argument("--methods", nargs="+", default=["fuse", "paper"])
    parser.add_argument("--fit", nargs=2, help=argparse.SUPPRESS)
    add_device(parser)
    args = parser.parse_args()
    if args.fit is not None:
        fit(args.scene, args.features, args.fit[0], Path(args.fit[1]), args.device)
        return
    with tempfile.TemporaryDirectory() as folder:
        scene = args.scene or make_toy_room(Path(folder) / "room")
        for method in args.methods:
            compare(scene, args.features or scene / "features", method, Path(folder) / method, args.device)


if __name__ == "__main__":
    main()
