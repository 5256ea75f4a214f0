"""The pictures of docs/results.md, "Edits on the real scene": the chairs removed, the plant recoloured.

python benchmarks/edit_pictures.py LABELLED_SPLAT ROOM_0 OUT
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from PIL import Image

from kfgs import read_splats
from kfgs.gaussians import Gaussians
from kfgs.labels import EditList, InBox, OfClass, Recolor, Remove, connected_parts
from kfgs.scenes import Scene, load_scene
from kfgs.splat.rasterize import render_color
from kfgs.viz.pictures import picture_grid

AROUND_CHAIR = 0.05  # metres around a chair's box: a cushion leans over its edge
ABOVE_RUG = 0.03  # metres above which all in the boxes is taken for a rest of the chairs: the wall stands behind
AROUND_PLANT = 0.2  # metres beside and above the plant's box: petals with another label
RED = (0.753, 0.251, 0.251)  # #c04040
LARGEST = 1500  # pixels of the longer side


def draw(path: Path, scene: Scene, views: list[str], clouds: dict[str, Gaussians]) -> None:
    """One row per viewpoint, one column per cloud."""
    cameras = scene.select(views).cameras
    sheet = Image.fromarray(
        picture_grid([[render_color(cloud, camera) for cloud in clouds.values()] for camera in cameras], tuple(clouds))
    )
    sheet.thumbnail((LARGEST, LARGEST))
    sheet.save(path, quality=85)
    print(f"wrote {path} ({sheet.width}x{sheet.height})")


def removals(before: Gaussians) -> dict[str, Gaussians]:
    """The chairs by name, then all else in their boxes: cushions, and specks of them that carry another label."""
    chairs = connected_parts(before.gaussians, OfClass("chair").select(before))
    rug = before.gaussians.means[before.gaussians.labels == before.names.index("rug")]  # the chairs stand on it
    lowest = float(rug[:, 2].median()) + ABOVE_RUG  # z points up; feet reach below their chair's Gaussians
    boxes: list[InBox] = []
    for chair in chairs:
        print(chair)
        low, high = (corner.tolist() for corner in chair.extent)
        boxes.append(
            InBox(
                (low[0] - AROUND_CHAIR, low[1] - AROUND_CHAIR, lowest),
                (high[0] + AROUND_CHAIR, high[1] + AROUND_CHAIR, high[2] + AROUND_CHAIR),
            )
        )
    by_name = EditList().then(Remove(OfClass("chair")))
    by_place = by_name.then(Remove(boxes))
    return {
        "before": before.gaussians,
        "chair removed": by_name.apply(before).gaussians,
        "and all else in their boxes": by_place.apply(before).gaussians,
    }


def recolors(before: Gaussians) -> dict[str, Gaussians]:
    """The plant by name, then with the petals in its box that carry another label."""
    plant = connected_parts(before.gaussians, OfClass("plant").select(before))[0]
    print(plant)
    low, high = plant.extent
    aside = torch.tensor([AROUND_PLANT, AROUND_PLANT, 0.0], dtype=low.dtype)  # below it stands its vase
    box = InBox(tuple((low - aside).tolist()), tuple((high + AROUND_PLANT).tolist()))
    others = [OfClass(name).select(before) for name in ("table", "book", "vase")]
    petals = box.select(before) - others[0] - others[1] - others[2]
    return {
        "before": before.gaussians,
        "plant recoloured": EditList().then(Recolor(OfClass("plant"), RED)).apply(before).gaussians,
        "and all its petals": EditList().then(Recolor(["plant", petals], RED)).apply(before).gaussians,
    }


def main(splats: Path, folder: Path, out: Path) -> None:
    """Edit, and draw before and after."""
    before, scene = read_splats(splats), load_scene(folder)
    out.mkdir(parents=True, exist_ok=True)
    removed = removals(before)
    draw(out / "room_0_remove.jpg", scene, ["rgb_0", "rgb_200"], removed)
    draw(out / "room_0_remove_close.jpg", scene, ["rgb_640"], removed)
    draw(out / "room_0_recolor.jpg", scene, ["rgb_870", "rgb_225"], recolors(before))


if __name__ == "__main__":
    if len(sys.argv) != 4:
        raise SystemExit(__doc__)
    main(*map(Path, sys.argv[1:]))
