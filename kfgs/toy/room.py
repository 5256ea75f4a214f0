"""The furnished room: its classes, and its solids from `room.json`, with their positions and materials."""

from __future__ import annotations

from importlib.resources import files

import numpy as np

from .._files import parse_json
from .geometry import Solid, Texture

CLASSES = (
    "wall", "floor", "ceiling", "rug", "table", "chair", "sofa", "cushion", "cabinet", "plant", "lamp", "picture", "door",
)  # fmt: skip
GROUPS = (  # classes whose embeddings lie closer together
    ("wall", "ceiling", "floor", "door", "rug"),
    ("chair", "sofa", "cushion", "rug"),
    ("table", "cabinet", "chair"),
    ("plant", "lamp", "picture"),
)
ROOM = (6.0, 5.0, 2.9)  # metres: inner width (x), depth (y), height (z); the floor is z = 0, centred on the origin


def build_room(seed: int) -> list[Solid]:
    """The solids of the toy room; `seed` changes textures, hues and how the chairs stand.

    A piece of `room.json` has parts: shape, centre and half sizes in its own axes, which are turned by `yaw` (degrees) and
    moved to `at`. A loose one stands a little elsewhere; each gets a shift of its colours, and each part a texture seed.
    """
    rng = np.random.default_rng([seed, 1])
    solids = []
    for piece in parse_json(files("kfgs.toy").joinpath("room.json").read_text()):
        dx, dy, dyaw = rng.uniform(-1, 1, 3) * (0.03, 0.03, 5.0) if piece.get("loose") else (0.0, 0.0, 0.0)
        at_x, at_y, at_z = piece["at"][0] + float(dx), piece["at"][1] + float(dy), piece["at"][2]
        a = np.deg2rad(piece["yaw"] + float(dyaw))
        hues = np.clip(np.array(piece["texture"]["colors"]) + rng.uniform(-0.012, 0.012, (1, 3)), 0.02, 0.98)
        colors = tuple((float(r), float(g), float(b)) for r, g, b in hues)
        for shape, (x, y, z), half in piece["parts"]:
            skin = Texture(**{**piece["texture"], "colors": colors, "seed": int(rng.integers(2**31))})
            right, back = float(at_x + np.cos(a) * x - np.sin(a) * y), float(at_y + np.sin(a) * x + np.cos(a) * y)
            solids.append(Solid(shape, (right, back, at_z + z), tuple(half), float(a), piece["label"], skin))
    return solids
