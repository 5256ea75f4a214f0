"""The pictures of docs/results.md, "Edits on the real scene": the chair removed, the plant recoloured, from two viewpoints.

python benchmarks/edit_pictures.py LABELLED_SPLAT ROOM_0 OUT
"""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image

from kfgs import read_splats
from kfgs.gaussians import Gaussians
from kfgs.labels import EditList, InBox, OfClass, Recolor, Remove, answers, select_by_label
from kfgs.pipeline import render_color
from kfgs.scenes import Scene, load_scene
from kfgs.viz.pairs import picture_grid

MARGIN = 0.05  # metres around the chairs: a cushion leans over their edge
LARGEST = 1500  # pixels of the longer side


def draw(path: Path, scene: Scene, views: list[str], clouds: dict[str, Gaussians]) -> None:
    """One row per viewpoint, one column per cloud."""
    cameras = scene.select(views).cameras
    sheet = Image.fromarray(
        picture_grid([[render_color(cloud, camera) for cloud in clouds.values()] for camera in cameras], tuple(clouds))
    )
    sheet.thumbnail((LARGEST, LARGEST))
    sheet.save(path, quality=88)
    print(f"wrote {path} ({sheet.width}x{sheet.height})")


def main(splats: Path, folder: Path, out: Path) -> None:
    """Edit, and draw before and after."""
    before, scene = read_splats(splats), load_scene(folder)
    out.mkdir(parents=True, exist_ok=True)
    chairs = answers(before.gaussians, select_by_label(before.gaussians, "chair", before.classes))[0]
    print(chairs)
    low, high = chairs.extent
    on_them = OfClass("cushion") & InBox(tuple((low - MARGIN).tolist()), tuple((high + MARGIN).tolist()))
    removed = EditList().then(Remove(OfClass("chair")))
    cleared = removed.then(Remove(on_them))
    removals = {
        "before": before.gaussians,
        "chair removed": removed.apply(before).gaussians,
        "and the cushions on it": cleared.apply(before).gaussians,
    }
    draw(out / "room_0_remove.jpg", scene, ["rgb_0", "rgb_200"], removals)
    painted = EditList().then(Recolor(OfClass("plant"), (0.753, 0.251, 0.251))).apply(before)
    recolored = {"before": before.gaussians, "plant recoloured": painted.gaussians}
    draw(out / "room_0_recolor.jpg", scene, ["rgb_200", "rgb_235"], recolored)


if __name__ == "__main__":
    if len(sys.argv) != 4:
        raise SystemExit(__doc__)
    main(*map(Path, sys.argv[1:]))
