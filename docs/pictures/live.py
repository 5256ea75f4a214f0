"""Make the scene of the viewer that the site shows live: `live.kfgs` and `live.spz`, small enough to be kept here.

    python notebooks/run.py 1 && python docs/pictures/live.py notebooks/data/room

The page itself is written when the site is built (docs/_ext/kfgs_live.py).
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import kfgs

HERE = Path(__file__).resolve().parent
GAUSSIANS, SEMANTIC, CAMERAS = 30_000, 10_000, 6


def main(folder: Path) -> None:
    """Fit a scene with few Gaussians, and keep every number in few bits."""
    scene = kfgs.load_scene(folder).undistorted()
    maps = kfgs.FeatureFolder(folder / "features").of(scene, "train")
    color = kfgs.ColorConfig.quick()
    color = replace(color, sh_degree=0, training=color.training.with_maximum(GAUSSIANS))
    method = kfgs.Uplift(color=color)
    method = replace(method, uplift=replace(method.uplift, max_gaussians=SEMANTIC))
    with tempfile.TemporaryDirectory() as run:
        field = kfgs.fit(scene, maps, method, folder=run, report=print)
        kfgs.write_splats(kfgs.read_splats(Path(run, "color.ply")), HERE / "live.spz")
    cameras = field.cameras[:: len(field.cameras) // CAMERAS][:CAMERAS]
    replace(field, cameras=cameras).save(HERE / "live.kfgs", "tiny")
    for file in (HERE / "live.spz", HERE / "live.kfgs"):
        print(f"{file.name}: {file.stat().st_size:,} bytes")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
