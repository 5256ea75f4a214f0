"""How far the surfaces that clouds show are from the true ones: colour field, default field, the paper's field.

    python benchmarks/geometry.py SCENE CLOUD...        # a CLOUD is a splat or a field.kfgs in the frame of the scene

SCENE has depth/<stem>.npy, float32 [H, W] z-depth, 0 where nothing is known (`make_toy_room`, benchmarks/rooms.py).
Of all pixels of the test views where a surface is known: the median of |depth - true depth|, the share of pixels within 5 % of
the true depth, and the share that shows nothing. The depth of a rendering is the median one (`Rendering.depth`).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from kfgs import Camera, Gaussians, SemanticField, load_scene, rasterize, read_splats

NEAR = 0.05  # of the true depth


def depth_errors(cloud: Gaussians, views: list[tuple[Camera, torch.Tensor]]) -> tuple[float, float, float]:
    """Median error in the scene's units, the share of pixels with a small one, and the share that shows nothing."""
    errors, shares = [], []
    for camera, true in views:
        with torch.no_grad():
            shown = rasterize(cloud, camera).depth
        known = true > 0
        error = torch.where(shown > 0, (shown - true).abs(), torch.inf)[known]
        errors.append(error)
        shares.append(error / true[known])
    error, share = torch.cat(errors), torch.cat(shares)
    return float(error.median()), float((share <= NEAR).double().mean()), float(error.isinf().double().mean())


def main() -> None:
    """Print one row for each cloud."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("clouds", type=Path, nargs="+", metavar="CLOUD")
    args = parser.parse_args()
    scene = load_scene(args.scene)  # these scenes have no distortion
    stems = {i: args.scene / "depth" / f"{scene.stem(i)}.npy" for i in scene.views("test")}
    views = [(scene.cameras[i], torch.from_numpy(np.load(file))) for i, file in stems.items()]
    print("| cloud | Gaussians | median error | within 5 % | shows nothing |\n|---|---|---|---|---|")
    for path in args.clouds:
        cloud = SemanticField.load(path).gaussians if path.suffix == ".kfgs" else read_splats(path)
        error, near, nothing = depth_errors(cloud, views)
        print(f"| {path} | {len(cloud):,} | {error:.3f} | {near:.1%} | {nothing:.1%} |", flush=True)


if __name__ == "__main__":
    main()
