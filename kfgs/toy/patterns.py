"""The materials of the toy room: calm patterns, with enough fine detail for SIFT on every surface.

A pattern is a function of the material, the noise and the places that are asked for. A colour depends only on the place on
the object, so all views agree on it. Detail finer than a pixel fades out instead of aliasing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import grid_sample

from .geometry import Array, Places, Solid, Texture

LATTICE = 48  # random values along each edge of the noise volume, mirrored beyond it


class Noise:
    """Band-limited value noise in [-1, 1] over R^3: a random lattice, interpolated trilinearly by `grid_sample`."""

    def __init__(self, rng: np.random.Generator) -> None:
        values = rng.uniform(-1.0, 1.0, (1, 1, LATTICE, LATTICE, LATTICE))
        self.volume = torch.from_numpy(values.astype(np.float32))

    def fractal(self, points: Array, wavelength: float, footprint: Array, octaves: int, gain: float = 0.7) -> Array:
        """The noise at points [N, 3], in octaves from `wavelength` (metres) down.

        An octave has a lattice point every half wavelength; one near the size of a pixel (`footprint` [N], metres) is faded.
        """
        total, weight = np.zeros(len(points)), 1.0
        for octave in range(octaves):
            fade = np.clip((wavelength / footprint - 1.0) / 2.0, 0.0, 1.0)
            if weight * fade.max(initial=0.0) > 0:
                at = (points + 0.37 * octave) * (4.0 / (wavelength * (LATTICE - 1)))
                grid = torch.from_numpy(at.astype(np.float32))[None, None, None]
                out = grid_sample(self.volume, grid, mode="bilinear", padding_mode="reflection", align_corners=True)
                total += weight * fade * out.flatten().double().numpy()
            weight, wavelength = weight * gain, wavelength / 2.13  # not 2: the mirrored periods must not line up
        return total


def hashed(cells: NDArray[np.int64], seed: int) -> Array:  # [N, n] -> [N] in [0, 1)
    """A fixed random number for each integer cell."""
    mixed = np.full(len(cells), seed * 7919 + 17, np.uint64)
    for column in cells.astype(np.uint64).T:
        mixed = (mixed ^ column) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    return (mixed >> np.uint64(11)).astype(np.float64) / 2.0**53


class Spots(NamedTuple):
    """Places on the surface of one object."""

    plane: Array  # [N, 2] metres on the face, from its centre; on an upright face, the second is the height
    edge: Array  # [N, 2] half sizes of the face
    inset: Array  # [N] metres from the face's nearest edge
    axis: NDArray[np.int64]  # [N] the face's normal axis
    grain: Array  # [N] fine noise
    footprint: Array  # [N] metres a pixel covers
    fibres: Array  # [N, 3] where to read noise that is drawn out along the longest edge
    place: Array  # [N, 3] where to read other noise


def _ramp(colors: tuple[tuple[float, float, float], ...], value: Array) -> Array:  # [N] in [0, 1] -> [N, 3]
    """Piecewise linear colours over [0, 1]; the first and the last beyond."""
    stops = np.linspace(0.0, 1.0, len(colors))
    return np.stack([np.interp(value, stops, [c[i] for c in colors]) for i in range(3)], axis=-1)


def _cover(distance: Array, reach: float, footprint: Array) -> Array:  # [N] -> [N] in [0, 1]
    """How much of a pixel lies within `reach` of a line from which its centre is `distance` away."""
    return np.clip((reach - np.abs(distance)) / footprint + 0.5, 0.0, 1.0) * np.clip(2 * reach / footprint, 0.0, 1.0)


def _mix(below: Array, above: Array | tuple[float, ...], share: Array) -> Array:  # [N, 3], [N, 3], [N] -> [N, 3]
    return below + (np.asarray(above) - below) * share[:, None]


def _plaster(texture: Texture, noise: Noise, spots: Spots) -> Array:
    return _ramp(texture.colors[:2], 0.5 + 0.4 * noise.fractal(spots.place, 0.9, spots.footprint, octaves=2))


def _sprigs(texture: Texture, noise: Noise, spots: Spots) -> Array:
    """Wallpaper: scattered leaves; each has its own place, turn, size and tint, so that SfM can tell them apart."""
    s, (u, v) = texture.scale, spots.plane.T / texture.scale
    cell = np.stack([np.floor(u), np.floor(v)], -1).astype(np.int64)
    turn, tone, length, right, up = (hashed(cell, texture.seed + k) for k in range(5))
    x, y = (u - cell[:, 0] - 0.3 - 0.4 * right) * s, (v - cell[:, 1] - 0.3 - 0.4 * up) * s
    angle = np.pi * turn
    along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    reach = s * (0.10 + 0.20 * length)
    leaf = (0.25 + 0.35 * tone) * reach * (1.0 - (along / reach) ** 2)
    inside = np.clip((leaf - np.abs(across)) / spots.footprint + 0.5, 0.0, 1.0)
    vein = _cover(across, 0.0025, spots.footprint) * (np.abs(along) < reach)
    shade = _ramp(texture.colors, np.clip(0.25 + 0.75 * tone, 0, 1) * (1.0 - 0.7 * vein))
    return _mix(_plaster(texture, noise, spots), shade, inside)


def _threads(texture: Texture, noise: Noise, spots: Spots, wavelength: float) -> Array:  # [N]
    """Woven threads: noise drawn out along one direction, and along the other."""
    third = spots.axis * 0.7 + texture.seed % 997 * 0.03  # other threads on each face of each object
    total = np.zeros(len(spots.plane))
    for stretch in ((0.12, 1.0), (1.0, 0.12)):
        at = np.column_stack([spots.plane * stretch, third + stretch[0]])
        total += noise.fractal(at, wavelength, spots.footprint, octaves=3)
    return total


def _stripes(texture: Texture, noise: Noise, spots: Spots) -> Array:
    """Woven stripes of unequal widths, in the colours' order."""
    at = spots.plane[:, 0] / texture.scale
    phase = at - np.floor(at)
    color = np.broadcast_to(np.array(texture.colors[0]), (len(at), 3))
    for k, (middle, reach) in enumerate(((0.3, 0.13), (0.62, 0.05), (0.86, 0.03))):
        share = _cover((phase - middle) * texture.scale, reach * texture.scale, spots.footprint)
        color = _mix(color, texture.colors[1 + k % (len(texture.colors) - 1)], share)
    return color * (1.0 + 0.06 * _threads(texture, noise, spots, 0.05))[:, None]


def _fibre_tone(texture: Texture, noise: Noise, spots: Spots) -> Array:  # [N] in [0, 1]
    """Growth rings that were cut along, under fine grain."""
    wave = noise.fractal(spots.fibres, 0.5, spots.footprint, octaves=2)
    rings = np.sin(2 * np.pi * ((spots.fibres @ np.ones(3)) / texture.scale + 1.6 * wave))
    return 0.5 + 0.22 * rings + 0.3 * spots.grain


def _planks(texture: Texture, noise: Noise, spots: Spots) -> Array:
    """Floor boards of equal width, each with a tone of its own, and thin dark joints."""
    s, (u, v) = texture.scale, spots.plane.T
    row = np.floor(v / s).astype(np.int64)
    along = u / (9.0 * s) + hashed(row[:, None], texture.seed)
    tone = hashed(np.stack([row, np.floor(along).astype(np.int64)], -1), texture.seed)
    color = _ramp(texture.colors, 0.1 + 0.65 * tone + 0.25 * spots.grain)
    joint = np.maximum(
        _cover((v / s - np.round(v / s)) * s, 0.003, spots.footprint),
        _cover((along - np.round(along)) * 9.0 * s, 0.002, spots.footprint),
    )
    return color * (1.0 - 0.65 * joint)[:, None]


def _panel(texture: Texture, noise: Noise, spots: Spots) -> Array:
    """A door or a drawer's front: a frame around a sunken panel, and a knob of the last colour."""
    color = _ramp(texture.colors[:-1], _fibre_tone(texture, noise, spots))
    broad = spots.edge.min(-1) > 0.15  # the narrow sides have no panel
    color = color * (1.0 - broad * 0.4 * _cover(spots.inset - texture.scale, 0.006, spots.footprint))[:, None]
    color = color * (1.0 + broad * 0.2 * _cover(spots.inset - texture.scale - 0.012, 0.006, spots.footprint))[:, None]
    knob = np.hypot(spots.plane[:, 0] - 0.82 * spots.edge[:, 0], spots.plane[:, 1]) - 0.012
    return _mix(color, texture.colors[-1], broad * np.clip(0.5 - knob / spots.footprint, 0.0, 1.0))


def _books(texture: Texture, noise: Noise, spots: Spots) -> Array:
    """A bookcase: wood, and on the front a shelf of books whose spines have the later colours."""
    color = _ramp(texture.colors[:2], _fibre_tone(texture, noise, spots))
    front = (spots.axis == 0) * np.clip((spots.inset - 0.025) / spots.footprint + 0.5, 0.0, 1.0)
    s, (u, v) = texture.scale, spots.plane.T
    at = u / s + 0.3 * np.sin(2.1 * u / s) + 31.0  # spines of unequal width
    book = np.floor(at).astype(np.int64)[:, None]
    tone, height = hashed(book, texture.seed), hashed(book, texture.seed + 1)
    spines = np.array(texture.colors[2:])
    spine = spines[(tone * len(spines)).astype(int)] * (0.85 + 0.3 * height)[:, None]
    rounding = 1.0 - 1.6 * (at - np.floor(at) - 0.5) ** 2
    width = 0.012 + 0.02 * float(hashed(np.array([[3]]), texture.seed)[0])
    label = _cover(v - (0.1 + 0.1 * tone), width, spots.footprint)
    spine = _mix(spine * rounding[:, None], (0.82, 0.78, 0.68), 0.7 * label)
    top = spots.edge[:, 1] * (0.35 + 0.5 * height) - v
    shadow = _mix(0.25 * color, spine, np.clip(top / spots.footprint + 0.5, 0.0, 1.0))
    return color + (shadow - color) * front[:, None]


def _rug(texture: Texture, noise: Noise, spots: Spots) -> Array:
    """Diamonds in fine lines on a light ground, with a border; the pile makes them a little uneven."""
    pile = noise.fractal(spots.place, 0.09, spots.footprint, octaves=3)
    u, v = (spots.plane + 0.006 * pile[:, None]).T
    s = texture.scale
    color = _ramp(texture.colors[:2], 0.5 + 0.35 * _threads(texture, noise, spots, 0.06))
    grid = np.stack([u / s + 0.62 * v / s, u / s - 0.62 * v / s], -1)
    cell = np.floor(grid).astype(np.int64)
    lines = _cover((grid - np.round(grid)) * s * 0.85, 0.011, spots.footprint[:, None]).max(-1)
    heart = np.abs(grid - cell - 0.5).sum(-1)
    filled = hashed(cell, texture.seed) < 0.55
    color = _mix(color, texture.colors[3], filled * np.clip((0.22 - heart) * s / spots.footprint + 0.5, 0.0, 1.0))
    color = _mix(color, texture.colors[2], 0.85 * lines)
    color = _mix(color, texture.colors[0], np.clip((0.15 - spots.inset) / spots.footprint + 0.5, 0.0, 1.0))
    for middle, reach, which in ((0.15, 0.012, 2), (0.085, 0.028, 3), (0.03, 0.008, 2)):
        color = _mix(color, texture.colors[which], _cover(spots.inset - middle, reach, spots.footprint))
    return color * (1.0 + 0.07 * pile)[:, None]


def _leaves(texture: Texture, noise: Noise, spots: Spots) -> Array:
    """Foliage: each place belongs to the nearest of scattered leaves, bright in its middle and dark at its rim."""
    at = spots.place / texture.scale * (1.0, 1.0, 0.6)
    steps = np.array(list(np.ndindex(3, 3, 3)))[:, None] - 1
    cells = (np.floor(at).astype(np.int64) + steps).reshape(-1, 3)  # [27 N, 3]
    middles = cells + np.stack([hashed(cells, texture.seed + k) for k in range(3)], -1)
    away = middles.reshape(27, -1, 3) - at
    distances = np.sqrt(np.einsum("kij,kij->ki", away, away))
    nearest, second = np.sort(distances, axis=0)[:2]
    tone = hashed(cells, texture.seed + 3).reshape(27, -1)[distances.argmin(0), np.arange(len(at))]
    body = np.clip((second - nearest) / 0.45, 0.0, 1.0)
    return _ramp(texture.colors, body * (0.45 + 0.55 * tone))


def _framed(texture: Texture, spots: Spots, picture: Array) -> Array:
    """A picture within a white mount and a frame of the first colour."""
    color = _mix(picture, (0.90, 0.89, 0.85), _cover(spots.inset, 0.085, spots.footprint))
    frame = np.array(texture.colors[0]) * (1.0 + 0.25 * spots.grain)[:, None]
    return color + (frame - color) * _cover(spots.inset, 0.028, spots.footprint)[:, None]


def _hills(texture: Texture, noise: Noise, spots: Spots) -> Array:
    """A landscape: a sky, a low sun, and ranges of hills, the nearest darkest."""
    (u, v), h = spots.plane.T, spots.edge[:, 1]
    sky, sun, *ranges = texture.colors[1:]
    color = _mix(np.broadcast_to(np.array(sky), (len(u), 3)), (0.97, 0.93, 0.86), np.clip(0.5 - v / h, 0.0, 1.0))
    disc = np.hypot(u - 0.2 * spots.edge[:, 0], v - 0.22 * h) - 0.055
    color = _mix(color, sun, np.clip(0.5 - disc / spots.footprint, 0.0, 1.0))
    for k, tone in enumerate(ranges):
        at = np.stack([u + 3.0 * k, np.full_like(u, 0.4 + k), np.zeros_like(u)], -1)
        ridge = h * (0.18 - 0.3 * k) + 0.07 * noise.fractal(at, 0.7, np.full(len(u), 1e-3), octaves=4, gain=0.45)
        share = np.clip((ridge - v) / spots.footprint + 0.5, 0.0, 1.0)
        haze = 0.35 * np.clip((ridge - v) / (0.5 * h), 0.0, 1.0)
        color = _mix(color, _mix(np.broadcast_to(np.array(tone), color.shape), (0.93, 0.92, 0.88), haze), share)
    return _framed(texture, spots, color)


def _shapes(texture: Texture, noise: Noise, spots: Spots) -> Array:
    """An abstract print: discs and arches of flat colours."""
    (u, v), (w, h) = spots.plane.T, spots.edge.T
    color = np.broadcast_to(np.array(texture.colors[1]), (len(u), 3))
    rng = np.random.default_rng([texture.seed, 7])
    for k, tone in enumerate(texture.colors[2:] * 2):
        x, y = rng.uniform(-0.62, 0.62), rng.uniform(-0.4, 0.4)
        reach = rng.uniform(0.07, 0.15) / (1 + k // 3 * 0.6)
        away = np.hypot(u - x * w, v - y * h)
        inside = np.clip((reach - away) / spots.footprint + 0.5, 0.0, 1.0)
        if k % 3 == 1:
            inside = _cover(away - reach, 0.018, spots.footprint)
        elif k % 3 == 2:
            inside *= v > y * h
        color = _mix(color, tone, inside)
    return _framed(texture, spots, color)


PATTERNS: dict[str, Callable[[Texture, Noise, Spots], Array]] = {
    "plaster": _plaster, "sprigs": _sprigs, "stripes": _stripes, "planks": _planks, "panel": _panel, "books": _books,
    "rug": _rug, "leaves": _leaves, "hills": _hills, "shapes": _shapes,
    "weave": lambda skin, noise, spots: _ramp(skin.colors, 0.5 + 0.3 * _threads(skin, noise, spots, skin.scale)),
    "wood": lambda skin, noise, spots: _ramp(skin.colors, _fibre_tone(skin, noise, spots)),
}  # fmt: skip


def evaluate(solid: Solid, noise: Noise, places: Places, footprint: Array) -> Array:  # [N] -> [N, 3] RGB, not clipped
    """The unlit colour of places on an object, where a pixel covers `footprint` metres."""
    texture, half, local = solid.texture, np.array(solid.half), solid.to_local(places.points)
    axis = np.argmax(np.abs(places.normals @ solid.rotation()), axis=-1)
    across = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    plane, edge = np.take_along_axis(local, across, axis=1), half[across]
    if solid.shape == "ellipsoid":  # a cushion, seen from its front, or a lamp's shade: around it, and up
        around = local[:, 0] if half[1] < 0.6 * half[0] else np.arctan2(local[:, 1], local[:, 0]) * half[0]
        plane, edge = np.stack([around, local[:, 2]], -1), np.broadcast_to(half[[0, 2]], plane.shape)
    shift = np.random.default_rng([texture.seed, 5]).uniform(-9.0, 9.0, 3)
    fibre = np.where(np.arange(3) == np.argmax(half), 0.08, 1.0)  # grain runs along the longest edge
    streaks = fibre if texture.kind in ("wood", "planks", "panel", "books") else np.ones(3)
    grain = noise.fractal(local * streaks + shift, 0.12, footprint, octaves=5, gain=0.85)
    inset = (edge - np.abs(plane)).min(-1)
    spots = Spots(plane, edge, inset, axis, grain, footprint, local * fibre + shift, local + shift)
    color = PATTERNS[texture.kind](texture, noise, spots)
    return color * (1.0 + texture.contrast * grain[:, None])
