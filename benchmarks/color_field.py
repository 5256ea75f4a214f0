"""Fit a colour field to a scene and score it on the views that were held out.

    python benchmarks/color_field.py SCENE OUT [--preset cpu|quick|paper] [--steps N] [--pictures 4] [--device cuda]

Writes OUT/color.ply (a 3DGS PLY), OUT/scores.json (`kfgs-color/1`) and OUT/views/*.png: the rendering beside the picture.
Compare the published 3DGS with `--preset paper --device cuda`. The views are scored on the same device.
Name a new OUT for another device: a finished fit is kept.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path

import torch
from devices import add_device, clock, device_name
from PIL import Image
from torch import Tensor

from kfgs._files import write_json
from kfgs.evaluation.color import score_views
from kfgs.pipeline import ColorConfig, fit_color
from kfgs.pipeline.stages import Run
from kfgs.scenes import load_scene


def main() -> None:
    """Fit, score, and say what it took."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene")
    parser.add_argument("out", type=Path)
    parser.add_argument("--preset", choices=("cpu", "quick", "paper"), default="cpu")
    parser.add_argument("--steps", type=int, help="the preset's schedule compressed or stretched to so many steps")
    parser.add_argument("--pictures", type=int, default=4, help="how many test views to draw")
    add_device(parser)
    args = parser.parse_args()
    scene = load_scene(args.scene).undistorted()
    config: ColorConfig = getattr(ColorConfig, args.preset)()
    if args.steps:
        config = replace(config, training=config.training.with_steps(args.steps))
    loads: list[float] = []

    def tell(row: dict[str, float]) -> None:
        loads.append(os.getloadavg()[0])
        if row["step"] % 250 == 0:
            print(f"{row}, load {loads[-1]:.1f}", flush=True)

    trained = fit_color(scene, args.out, config, report=print, progress=tell)
    took = sum(stage.seconds for stage in Run(args.out).finished("color"))
    chosen = [scene.stem(i) for i in scene.views("test")]
    chosen = chosen[:: max(1, len(chosen) // max(1, args.pictures))][: args.pictures]

    def draw(stem: str, rendered: Tensor, taken: Tensor) -> None:
        if stem in chosen:
            path = args.out / "views" / f"{stem}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray((torch.cat([rendered, taken], dim=1) * 255).round().byte().cpu().numpy()).save(path)

    gaussians, reports = trained.to(args.device), []
    seconds = clock(lambda: reports.append(score_views(gaussians, scene, show=draw)))
    report = reports[0]
    load = sum(loads) / len(loads) if loads else None
    facts = {
        "preset": args.preset,
        "steps": config.training.steps,
        "gaussians": len(trained),
        "seconds": took,
        "device": device_name(args.device),
        "threads": torch.get_num_threads(),
        "mean load of the machine": load,
        "seconds per scored view": seconds / len(report.views),
        "scores": report.to_json(),
    }
    write_json(args.out / "scores.json", facts)
    print(report)
    print(f"{len(trained)} Gaussians, {took / 60:.1f} minutes, {config.training.steps} steps, load {load}")


if __name__ == "__main__":
    main()
