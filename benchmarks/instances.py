"""Are the things of a class told apart? Found and counted things of a field, by views and by distance alone.

    python benchmarks/instances.py ROOM RUN [RUN ...]

ROOM is a toy room (`kfgs demo --out DEMO`: DEMO/scene) or a room of benchmarks/rooms.py; RUN a run folder or field of it. Truth
is the thing of each point of the surface: of the toy room by its solids, of a rendered room by its depth and instances. A
point belongs to the thing of the nearest Gaussian, if that is within 10 cm. A thing is found if one predicted thing covers
it with an IoU above 0.5. Walls, floors, ceilings and rugs are not counted.
"""

from __future__ import annotations

import argparse
import json
from importlib.resources import files
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy.spatial import cKDTree

from kfgs import SemanticField, load_scene
from kfgs.gaussians import Gaussians
from kfgs.labels import number_instances
from kfgs.labels.components import SPECK, number_parts
from kfgs.toy import build_room
from kfgs.toy.geometry import Solid

STUFF = ("wall", "floor", "ceiling", "rug")
REACH, OVERLAP = 0.1, 0.5  # metres; IoU
POINTS = 1_500  # of each view of a rendered room


def distance(solid: Solid, points: np.ndarray) -> np.ndarray:
    """Metres to the surface of a solid of the toy room, of an ellipsoid about."""
    local, half = solid.to_local(points), np.array(solid.half)
    if solid.shape == "ellipsoid":
        return np.abs(np.linalg.norm(local / half, axis=1) - 1) * half.min()
    outside = np.abs(local) - half
    return np.abs(np.linalg.norm(np.maximum(outside, 0), axis=1) + np.minimum(outside.max(1), 0))


def toy_truth(room: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of the surface [P, 3], their classes [P], their things [P]: one class and one place in room.json are one."""
    known = np.load(room / "surface.npz")
    solids = build_room(json.loads((room / "toy.json").read_text())["config"]["seed"])
    names, points = json.loads((room / "classes.json").read_text()), known["points"].astype(float)
    own = np.array([names.index(solid.label) for solid in solids])
    far = np.stack([distance(solid, points) for solid in solids], axis=1)
    far[known["labels"][:, None] != own] = np.inf
    pieces = json.loads(files("kfgs.toy").joinpath("room.json").read_text())
    keys = [(piece["label"], *piece["at"]) for piece in pieces for _ in piece["parts"]]
    things = np.array([sorted(set(keys)).index(key) for key in keys])
    return points, known["labels"].astype(int), things[far.argmin(1)]


def rendered_truth(room: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same of a rendered room, from random pixels of its views."""
    rng, rows = np.random.default_rng(0), []
    for camera in load_scene(room).cameras:
        stem = Path(camera.name).stem
        depth = np.load(room / "depth" / f"{stem}.npy")
        maps = [np.array(Image.open(room / kind / f"{stem}.png")) for kind in ("labels", "instances")]
        y, x = np.divmod(rng.choice(depth.size, POINTS, replace=False), depth.shape[1])
        y, x = (part[(depth[y, x] > 0) & (maps[0][y, x] != 255)] for part in (y, x))
        K, z = camera.K.double().numpy(), depth[y, x].astype(float)
        local = np.stack([(x + 0.5 - K[0, 2]) / K[0, 0] * z, (y + 0.5 - K[1, 2]) / K[1, 1] * z, z], axis=1)
        rows.append(
            np.column_stack(
                [(local - camera.t.double().numpy()) @ camera.R.double().numpy(), maps[0][y, x], maps[1][y, x]]
            )
        )
    table = np.concatenate(rows)
    return table[:, :3], table[:, 3].astype(int), table[:, 4].astype(int)


def by_distance(cloud: Gaussians) -> np.ndarray:
    """The connected parts of each class, as `number_instances` numbers them."""
    assert cloud.labels is not None
    numbers = torch.zeros(len(cloud), dtype=torch.int64)
    for label in cloud.labels.unique().tolist():
        parts = number_parts(cloud, cloud.labels == label)
        sizes = torch.bincount(parts[parts >= 0])
        numbers[parts >= 0] = torch.where(sizes >= SPECK * sizes[0], torch.arange(len(sizes)) + 1, 0)[parts[parts >= 0]]
    return numbers.numpy()


def score(truth: tuple[np.ndarray, ...], cloud: Gaussians, numbers: np.ndarray) -> dict[str, tuple[int, int, int]]:
    """For each class: its things, the predicted ones, and those that are found."""
    points, classes, things = truth
    near, which = cKDTree(cloud.means.numpy()).query(points)
    assert cloud.labels is not None
    labels = cloud.labels.numpy()
    said = np.where((near < REACH) & (numbers[which] > 0), 10_000 * labels[which] + numbers[which], -1)
    result = {}
    for label, name in enumerate(cloud.names):
        true = np.unique(things[classes == label])
        if name in STUFF or not len(true):
            continue
        found = 0
        for thing in true:
            own = (things == thing) & (classes == label)
            guesses = [said == guess for guess in np.unique(said[own & (said // 10_000 == label)])]
            found += any((own & guess).sum() > OVERLAP * (own | guess).sum() for guess in guesses)
        result[name] = len(true), len(np.unique(numbers[(labels == label) & (numbers > 0)])), found
    return result


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("room", type=Path)
    parser.add_argument("runs", type=Path, nargs="+")
    args = parser.parse_args()
    truth = (toy_truth if (args.room / "toy.json").is_file() else rendered_truth)(args.room)
    for run in args.runs:
        field = SemanticField.load(run)
        cloud = field.label()
        ways = {"distance": by_distance(cloud), "views": number_instances(cloud, field.cameras).extra["instance"]}
        for way, numbers in ways.items():
            table = score(truth, cloud, numbers)
            true, _, found = np.sum(list(table.values()), axis=0)
            right = sum(row[0] == row[1] for row in table.values())
            wrong = ", ".join(f"{name} {row[1]} of {row[0]}" for name, row in table.items() if row[0] != row[1])
            print(
                f"{run} by {way}: {found} of {true} found, {right} of {len(table)} counts right {wrong and f'({wrong})'}"
            )


if __name__ == "__main__":
    main()
