"""How many Gaussians does colour need? Fit red, green and blue as three channels and watch the count grow.

    python benchmarks/color_count.py SCENE [--size 240 320] [--steps 3000] [--device cuda]

This is a lower bound for a colour field of the scene: fewer steps, smaller pictures and no harmonics, through the same
`fit_field` and with the published densification threshold that the semantic field is compared at.
"""

from __future__ import annotations

import argparse

import torch
from devices import add_device

from kfgs.cameras import resize_map
from kfgs.fields import Densify, GaussianParams, Rates, Training, fit_field
from kfgs.scenes import load_scene


def main() -> None:
    """Fit and print the count every 250 steps."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene")
    parser.add_argument("--size", type=int, nargs=2, default=(240, 320), metavar=("H", "W"))
    parser.add_argument("--steps", type=int, default=3000)
    add_device(parser)
    args = parser.parse_args()
    scene = load_scene(args.scene).undistorted()
    views = scene.views("train")
    pictures = [resize_map(scene.image(i), tuple(args.size), antialias=True) for i in views]
    start = GaussianParams.from_points(scene.points, 3, generator=torch.Generator().manual_seed(0))
    start = start.map(lambda value: value.to(args.device))
    config = Training(
        steps=args.steps,
        rates=Rates(features=0.01),
        densify=Densify(200, 2500, reset_every=0, maximum=400_000),
        extent=scene.extent,
        render_scale=1.0,
        report_every=250,
    )
    cameras = [scene.cameras[i] for i in views]
    fit_field(start, cameras, pictures, config, progress=lambda row: print(row, flush=True))


if __name__ == "__main__":
    main()
