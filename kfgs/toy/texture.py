"""Procedural surface colour: calm materials, with enough fine detail for SIFT on every surface.

A colour depends only on the place on the object, so all views agree on it. Detail finer than a pixel fades out instead
of aliasing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from .noise import Array, Noise
from .patterns import PATTERNS, Spots

Color = tuple[float, float, float]


@dataclass(frozen=True)
class Texture:
    """The material of one object: its pattern, two or more colours (RGB in [0, 1]), its size in metres, its seed."""

    kind: Literal[
        "plaster", "sprigs", "weave", "stripes", "planks", "wood", "panel", "books", "rug", "leaves", "hills", "shapes"
    ]
    colors: tuple[Color, ...]
    scale: float = 0.2
    seed: int = 0
    contrast: float = 0.1  # of the fine noise on top, relative to the colour
    glow: float = 0.0  # light that it gives off by itself: a lamp's shade


def evaluate(
    texture: Texture,
    noise: Noise,
    local: Array,  # [N, 3] metres, in the object's axes
    axis: NDArray[np.int64],  # [N] the face's normal axis
    half: Array,  # [3] half edges or radii of the object
    footprint: Array,  # [N] metres a pixel covers there
    *,
    is_round: bool = False,
) -> Array:  # [N, 3] RGB, not clipped
    """The unlit colour of an object's points."""
    if is_round and half[1] < 0.6 * half[0]:  # a cushion, seen from its front
        plane, edge = local[:, [0, 2]], np.broadcast_to(half[[0, 2]], (len(local), 2))
    elif is_round:  # a lamp's shade: around it, and up
        around = np.arctan2(local[:, 1], local[:, 0]) * half[0]
        plane, edge = np.stack([around, local[:, 2]], -1), np.broadcast_to(half[[0, 2]], (len(local), 2))
    else:
        order = np.array([[1, 2], [0, 2], [0, 1]])[axis]
        plane, edge = np.take_along_axis(local, order, axis=1), half[order]
    shift = np.random.default_rng([texture.seed, 5]).uniform(-9.0, 9.0, 3)
    fibre = np.where(np.arange(3) == np.argmax(half), 0.08, 1.0)  # grain runs along the longest edge
    streaks = fibre if texture.kind in ("wood", "planks", "panel", "books") else np.ones(3)
    grain = noise.fractal(local * streaks + shift, 0.12, footprint, octaves=5, gain=0.85)
    spots = Spots(local, plane, edge, np.asarray(axis), grain, footprint, local * fibre + shift, local + shift)
    color = PATTERNS[texture.kind](texture, noise, spots)
    return color * (1.0 + texture.contrast * grain[:, None])
