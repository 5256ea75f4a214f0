"""The furnished room: its solids, their positions and materials."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from .geometry import Solid
from .texture import Color, Texture

CLASSES = (
    "wall",
    "floor",
    "ceiling",
    "rug",
    "table",
    "chair",
    "sofa",
    "cushion",
    "cabinet",
    "plant",
    "lamp",
    "picture",
    "door",
)
GROUPS = (  # classes whose embeddings lie closer together
    ("wall", "ceiling", "floor", "door", "rug"),
    ("chair", "sofa", "cushion", "rug"),
    ("table", "cabinet", "chair"),
    ("plant", "lamp", "picture"),
)
ROOM = (6.0, 5.0, 2.9)  # metres: inner width (x), depth (y), height (z); the floor is z = 0, centred on the origin
_THICK = 0.1

_Part = tuple[Literal["box", "ellipsoid"], tuple[float, float, float], tuple[float, float, float]]


def _jitter(colors: Sequence[Color], rng: np.random.Generator, amount: float = 0.012) -> tuple[Color, ...]:
    moved = np.clip(np.array(colors) + rng.uniform(-amount, amount, (1, 3)), 0.02, 0.98)
    return tuple((float(r), float(g), float(b)) for r, g, b in moved)


class _Builder:
    """Collects solids; `rng` gives each placed piece a shift of its colours and a texture seed."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.solids: list[Solid] = []

    def place(
        self,
        label: str,
        parts: Sequence[_Part],
        at: tuple[float, float, float],
        texture: dict[str, Any],
        *,
        yaw: float = 0.0,
    ) -> None:
        """Add a piece: parts are (shape, centre, half sizes) in its own axes, turned by `yaw` (degrees), moved to `at`."""
        colors = _jitter(texture["colors"], self.rng)
        a = np.deg2rad(yaw)
        for shape, (x, y, z), half in parts:
            skin = Texture(**{**texture, "colors": colors, "seed": int(self.rng.integers(2**31))})
            center = (
                float(at[0] + np.cos(a) * x - np.sin(a) * y),
                float(at[1] + np.sin(a) * x + np.cos(a) * y),
                at[2] + z,
            )
            self.solids.append(Solid(shape, center, half, float(a), label, skin))


def _shell(b: _Builder) -> None:
    """Floor, ceiling, four walls, a door."""
    X, Y, Z = ROOM[0] / 2, ROOM[1] / 2, ROOM[2]
    t = _THICK / 2
    oak = {"kind": "planks", "colors": ((0.60, 0.47, 0.34), (0.72, 0.58, 0.43), (0.80, 0.67, 0.52)), "scale": 0.16}
    b.place("floor", [("box", (0, 0, -t), (X, Y, t))], (0, 0, 0), {**oak, "contrast": 0.21})
    white = {"kind": "plaster", "colors": ((0.90, 0.89, 0.87), (0.95, 0.94, 0.92)), "contrast": 0.13}
    b.place("ceiling", [("box", (0, 0, Z + t), (X, Y, t))], (0, 0, 0), white)
    papers: list[dict[str, Any]] = [
        {"kind": "sprigs", "colors": ((0.66, 0.71, 0.66), (0.73, 0.77, 0.71), (0.50, 0.58, 0.52)), "scale": 0.24},
        {"kind": "sprigs", "colors": ((0.86, 0.84, 0.80), (0.91, 0.89, 0.85), (0.72, 0.71, 0.67)), "scale": 0.28},
        {"kind": "sprigs", "colors": ((0.83, 0.79, 0.73), (0.89, 0.86, 0.80), (0.70, 0.66, 0.60)), "scale": 0.26},
        {"kind": "sprigs", "colors": ((0.84, 0.81, 0.76), (0.90, 0.87, 0.82), (0.66, 0.65, 0.60)), "scale": 0.25},
    ]
    papers = [{**paper, "contrast": 0.15} for paper in papers]
    b.place("wall", [("box", (-X - t, 0, Z / 2), (t, Y, Z / 2))], (0, 0, 0), papers[0])
    b.place("wall", [("box", (X + t, 0, Z / 2), (t, Y, Z / 2))], (0, 0, 0), papers[1])
    b.place("wall", [("box", (0, -Y - t, Z / 2), (X, t, Z / 2))], (0, 0, 0), papers[2])
    b.place("wall", [("box", (0, Y + t, Z / 2), (X, t, Z / 2))], (0, 0, 0), papers[3])
    door = {"kind": "panel", "colors": ((0.80, 0.79, 0.76), (0.86, 0.85, 0.82), (0.45, 0.38, 0.28)), "scale": 0.11}
    b.place("door", [("box", (0, 0, 1.03), (0.46, 0.03, 1.03))], (-1.2, -Y + 0.03, 0), {**door, "contrast": 0.1})


def _seating(b: _Builder) -> None:
    """Sofa with cushions, five chairs."""
    cloth = {"kind": "weave", "colors": ((0.34, 0.42, 0.48), (0.50, 0.58, 0.63)), "scale": 0.04, "contrast": 0.16}
    sofa: list[_Part] = [
        ("box", (0, 0, 0.21), (1.05, 0.45, 0.21)),
        ("box", (0, 0.36, 0.62), (1.05, 0.11, 0.22)),
        ("box", (-1.17, 0, 0.31), (0.12, 0.47, 0.31)),
        ("box", (1.17, 0, 0.31), (0.12, 0.47, 0.31)),
    ]
    b.place("sofa", sofa, (0.45, 1.98, 0), cloth)
    covers: list[tuple[str, tuple[Color, ...]]] = [
        ("weave", ((0.78, 0.58, 0.26), (0.88, 0.70, 0.38))),
        ("stripes", ((0.90, 0.87, 0.80), (0.70, 0.42, 0.32), (0.36, 0.44, 0.48))),
        ("weave", ((0.68, 0.42, 0.32), (0.80, 0.55, 0.43))),
    ]
    for x, (kind, colors), turn in zip((-0.33, 0.40, 1.22), covers, (12, -6, -18), strict=True):
        skin = {"kind": kind, "colors": colors, "scale": 0.08, "contrast": 0.13}
        b.place("cushion", [("ellipsoid", (0, 0, 0), (0.31, 0.14, 0.25))], (x, 2.04, 0.66), skin, yaw=turn)
    beech = {"kind": "wood", "colors": ((0.66, 0.47, 0.31), (0.80, 0.62, 0.45)), "scale": 0.05, "contrast": 0.21}
    chair: list[_Part] = [
        ("box", (0, 0, 0.44), (0.24, 0.24, 0.045)),
        ("box", (0, 0.21, 0.72), (0.24, 0.04, 0.24)),
        ("box", (-0.2, 0, 0.2), (0.04, 0.23, 0.2)),
        ("box", (0.2, 0, 0.2), (0.04, 0.23, 0.2)),
    ]
    places = [(-0.30, 0.42, 8), (-0.36, -1.02, 176), (0.50, -1.10, 200), (1.05, -0.25, -84), (-1.75, -1.15, 62)]
    for x, y, turn in places:
        dx, dy, dyaw = b.rng.uniform(-1, 1, 3) * (0.03, 0.03, 5.0)
        b.place("chair", chair, (x + float(dx), y + float(dy), 0), beech, yaw=turn + float(dyaw))


def _storage(b: _Builder) -> None:
    """Table, two cabinets, rug."""
    wool = {
        "kind": "rug",
        "colors": ((0.84, 0.80, 0.72), (0.91, 0.88, 0.81), (0.45, 0.47, 0.48), (0.72, 0.50, 0.40)),
        "scale": 0.34,
        "contrast": 0.13,
    }
    b.place("rug", [("box", (0, 0, 0.008), (1.5, 1.15, 0.008))], (0.05, -0.05, 0), wool, yaw=3)
    ash = {"kind": "wood", "colors": ((0.72, 0.58, 0.42), (0.86, 0.74, 0.57)), "scale": 0.07, "contrast": 0.2}
    table: list[_Part] = [("box", (0, 0, 0.735), (0.68, 0.42, 0.035))]
    table += [("box", (x, y, 0.35), (0.055, 0.055, 0.35)) for x in (-0.58, 0.58) for y in (-0.32, 0.32)]
    b.place("table", table, (0.0, -0.3, 0), ash, yaw=-4)
    walnut: dict[str, Any] = {"colors": ((0.36, 0.25, 0.18), (0.50, 0.36, 0.26)), "scale": 0.06, "contrast": 0.16}
    fronts = {**walnut, "kind": "panel", "colors": (*walnut["colors"], (0.74, 0.66, 0.48))}
    spines = ((0.55, 0.34, 0.28), (0.34, 0.42, 0.46), (0.80, 0.74, 0.62), (0.44, 0.48, 0.38), (0.72, 0.58, 0.36))
    low: list[_Part] = [("box", (0, 0, 0.04), (0.17, 0.76, 0.04))]
    low += [("box", (0, y, 0.47), (0.21, 0.255, 0.39)) for y in (-0.53, 0.0, 0.53)]  # three doors, 2 cm gaps
    b.place("cabinet", low, (-2.76, 0.1, 0), fronts)
    tall: list[_Part] = [("box", (0, 0, z), (0.26, 0.42, 0.31)) for z in (0.32, 0.96, 1.60)]  # three shelves
    b.place("cabinet", tall, (2.71, -1.95, 0), {**walnut, "kind": "books", "colors": (*walnut["colors"], *spines)})


def _decoration(b: _Builder) -> None:
    """Plants, lamps, pictures."""
    leaves = {
        "kind": "leaves",
        "colors": ((0.13, 0.22, 0.13), (0.30, 0.43, 0.24), (0.52, 0.62, 0.38)),
        "scale": 0.07,
        "contrast": 0.2,
    }
    pot = {"kind": "plaster", "colors": ((0.68, 0.47, 0.37), (0.78, 0.58, 0.47)), "contrast": 0.13}
    b.place("plant", [("box", (0, 0, 0.2), (0.19, 0.19, 0.2))], (-2.45, 1.95, 0), pot, yaw=20)
    crown: list[_Part] = [("ellipsoid", (0, 0, 0.62), (0.22, 0.20, 0.30))]
    for k in range(6):
        a = k * np.pi / 3 + 0.4
        where = (0.22 * float(np.cos(a)), 0.22 * float(np.sin(a)), 0.85 + 0.13 * (k % 3))
        crown.append(("ellipsoid", where, (0.20, 0.17, 0.22)))
    crown.append(("ellipsoid", (0.02, 0.03, 1.28), (0.19, 0.19, 0.24)))
    b.place("plant", crown, (-2.45, 1.95, 0), leaves)
    b.place("plant", [("box", (0, 0, 0.07), (0.09, 0.09, 0.07))], (0.12, -0.24, 0.77), pot, yaw=10)
    small: list[_Part] = [
        ("ellipsoid", (0, 0, 0.24), (0.17, 0.15, 0.15)),
        ("ellipsoid", (0.05, 0, 0.38), (0.1, 0.1, 0.1)),
    ]
    b.place("plant", small, (0.12, -0.24, 0.77), leaves)
    silk = {
        "kind": "weave",
        "colors": ((0.86, 0.78, 0.64), (0.94, 0.88, 0.76)),
        "scale": 0.06,
        "contrast": 0.1,
        "glow": 0.3,
    }
    floor_lamp: list[_Part] = [
        ("ellipsoid", (0, 0, 0.0), (0.2, 0.2, 0.05)),
        ("box", (0, 0, 0.7), (0.045, 0.045, 0.7)),
        ("ellipsoid", (0, 0, 1.5), (0.34, 0.34, 0.28)),
    ]
    b.place("lamp", floor_lamp, (2.42, 1.9, 0), silk)
    desk_lamp: list[_Part] = [("box", (0, 0, 0.1), (0.05, 0.05, 0.1)), ("ellipsoid", (0, 0, 0.36), (0.23, 0.23, 0.2))]
    b.place("lamp", desk_lamp, (-2.76, 0.55, 0.86), silk)
    oak, black = (0.62, 0.48, 0.34), (0.20, 0.19, 0.18)
    prints: list[tuple[str, tuple[Color, ...]]] = [
        (
            "hills",
            (oak, (0.80, 0.84, 0.84), (0.90, 0.66, 0.44), (0.62, 0.70, 0.70), (0.40, 0.52, 0.54), (0.22, 0.33, 0.36)),
        ),
        ("shapes", (black, (0.90, 0.87, 0.80), (0.76, 0.50, 0.38), (0.30, 0.40, 0.44), (0.82, 0.66, 0.38))),
        ("shapes", (oak, (0.87, 0.86, 0.82), (0.42, 0.52, 0.46), (0.82, 0.66, 0.40), (0.26, 0.32, 0.36))),
        (
            "hills",
            (black, (0.90, 0.82, 0.74), (0.80, 0.44, 0.32), (0.78, 0.64, 0.56), (0.58, 0.48, 0.48), (0.32, 0.31, 0.36)),
        ),
    ]
    X, Y = ROOM[0] / 2, ROOM[1] / 2
    walls = [(-0.35, Y, 0, 0.45), (1.10, Y, 0, 0.40), (-X, -0.15, 90, 0.48), (X, 0.45, 90, 0.62)]
    for (x, y, turn, width), (kind, colors) in zip(walls, prints, strict=True):
        skin = {"kind": kind, "colors": colors, "contrast": 0.078}
        at = (x - 0.025 * np.sign(x) * (turn == 90), y - 0.025 * np.sign(y) * (turn == 0), 1.62)
        b.place("picture", [("box", (0, 0, 0), (width, 0.025, 0.36))], at, skin, yaw=turn)


def build_room(seed: int) -> list[Solid]:
    """The solids of the toy room; `seed` changes textures, hues and how the chairs stand."""
    builder = _Builder(np.random.default_rng([seed, 1]))
    for furnish in (_shell, _storage, _seating, _decoration):
        furnish(builder)
    return builder.solids
