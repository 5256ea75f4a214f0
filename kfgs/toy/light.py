"""Soft light in the room: lamps of some size, so that shadows have soft edges, and corners that get less of it.

All of it is computed from the place on the surface alone, in closed form, so all views agree on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .geometry import Array, Places, Solid, in_cone
from .room import ROOM


def _dot(a: Array, b: Array) -> Array:  # [N, 3], [N, 3] -> [N]
    return np.einsum("ij,ij->i", a, b)


class Lamp(NamedTuple):
    """A ball of light."""

    place: tuple[float, float, float]  # metres
    radius: float  # metres: a larger lamp has softer shadows
    color: tuple[float, float, float]  # RGB, linear
    reach: float  # metres: at this distance its light is halved


LAMPS = (
    Lamp((-0.4, 0.3, 2.75), 0.55, (0.88, 0.84, 0.77), 4.5),
    Lamp((2.2, -1.6, 2.6), 0.55, (0.44, 0.43, 0.42), 4.0),
)
GLOWS = (  # the two lamps of the room; they cast no shadows
    Lamp((2.42, 1.9, 1.5), 0.3, (1.10, 0.76, 0.40), 0.8),
    Lamp((-2.76, 0.55, 1.22), 0.2, (0.85, 0.58, 0.30), 0.6),
)
SKY, GROUND = (0.30, 0.305, 0.315), (0.34, 0.32, 0.29)  # what comes from everywhere: from above, and from the floor
NEAR = 0.22  # metres: how far a piece of furniture takes light from its surroundings
CORNER = 0.45  # metres: the same for walls, floor and ceiling
FLAT = ("wall", "floor", "ceiling", "rug", "picture", "door")  # too thin, or too large, to cast a shadow that is seen


def _to_surface(solid: Solid, local: Array) -> tuple[Array, Array]:  # [N, 3] -> [N], [N, 3]
    """Distance to the solid (0 inside) and the direction towards it, in its axes."""
    half = np.array(solid.half)
    if solid.shape == "box":
        way = np.clip(local, -half, half) - local
        distance = np.sqrt(_dot(way, way))
        return distance, way / np.maximum(distance, 1e-6)[:, None]
    scaled = local / half
    size = np.sqrt(_dot(scaled, scaled))
    slope = scaled / half
    steep = np.sqrt(_dot(slope, slope))
    return np.maximum(size - 1.0, 0.0) * size / np.maximum(steep, 1e-6), -slope / np.maximum(steep, 1e-6)[:, None]


def openness(solids: Sequence[Solid], places: Places) -> Array:  # [N] in [0, 1]
    """The share of the surroundings' light that reaches each place: less in corners, below and beside furniture."""
    points, outward, which = places
    left = np.ones(len(points))
    for axis, (low, high) in enumerate(((-ROOM[0] / 2, ROOM[0] / 2), (-ROOM[1] / 2, ROOM[1] / 2), (0.0, ROOM[2]))):
        for side, distance in ((-1.0, points[:, axis] - low), (1.0, high - points[:, axis])):
            facing = np.maximum(1.0 + side * outward[:, axis], 0.0) * (np.abs(outward[:, axis]) < 0.999)
            left *= 1.0 - 0.34 * facing * np.exp(-np.maximum(distance, 0.0) / CORNER)
    for i, solid in enumerate(solids):
        if solid.label in FLAT:
            continue
        away, reach = points - np.array(solid.center), float(np.linalg.norm(solid.half)) + 3 * NEAR
        rows = np.flatnonzero((_dot(away, away) < reach**2) & (which != i))
        distance, way = _to_surface(solid, solid.to_local(points[rows]))
        facing = 0.5 + 0.5 * _dot(way, outward[rows] @ solid.rotation())
        left[rows] *= 1.0 - 0.75 * facing * np.exp(-distance / NEAR)
    return left


def _clearance(solid: Solid, origin: Array, ways: Array) -> tuple[Array, Array]:  # [N, 3], [N, 3] -> [N], [N]
    """How far each segment passes by the solid (below 0: how deep it goes in), and where on it that is (0 to 1)."""
    o, d, half = solid.to_local(origin), ways @ solid.rotation(), np.array(solid.half)
    if solid.shape == "ellipsoid":
        o, d = o / half, d / half
        at = np.clip(-_dot(o, d) / np.maximum(_dot(d, d), 1e-12), 0.0, 1.0)
        nearest = o + at[:, None] * d
        return (np.sqrt(_dot(nearest, nearest)) - 1.0) * float(half.mean()), at
    # A step aside of length 1 changes the distance to a face by at most the sine between the way and the face's axis.
    aside = 1.0 / np.sqrt(np.maximum(1.0 - d * d / np.maximum(_dot(d, d), 1e-12)[:, None], 0.01))
    # The largest of (|o + t d| - half) * aside over the axes is convex in t: halve the interval by its slope.
    low, high = np.zeros(len(o)), np.ones(len(o))
    rows = np.arange(len(o))
    for _ in range(11):
        at = 0.5 * (low + high)
        place = o + at[:, None] * d
        axis = np.argmax((np.abs(place) - half) * aside, axis=-1)
        falling = place[rows, axis] * d[rows, axis] < 0
        low, high = np.where(falling, at, low), np.where(falling, high, at)
    return ((np.abs(o + at[:, None] * d) - half) * aside).max(-1), at


def lamps_seen(solids: Sequence[Solid], places: Places) -> Array:  # [N, L] in [0, 1]
    """The share of each lamp that each place sees; no solid shades itself, and what faces away is not asked."""
    points, outward, which = places
    seen = np.ones((len(points), len(LAMPS)))
    for k, lamp in enumerate(LAMPS):
        ways = np.array(lamp.place) - points
        lengths = np.sqrt(_dot(ways, ways))
        facing = np.flatnonzero(_dot(ways, outward) > -0.25 * lengths)
        rays = -ways[facing] / lengths[facing, None]
        for i, solid in enumerate(solids):
            if solid.label in FLAT:
                continue
            # A shadow's edge is as wide as the lamp times the blocker's share of the way, at most its share of the height.
            top = (solid.center[2] + solid.half[2]) / lamp.place[2]
            rows = facing[in_cone(solid, np.array(lamp.place), rays, lamp.radius * top)]
            rows = rows[(which[rows] != i) & (seen[rows, k] > 0.01)]
            clear, at = _clearance(solid, points[rows], ways[rows])
            soft = np.maximum(lamp.radius * at, 0.012)  # half the width of the shadow's edge
            part = np.clip(0.5 + 0.5 * clear / soft, 0.0, 1.0)
            seen[rows, k] *= part * part * (3.0 - 2.0 * part)
    return seen


def light_reaches(solids: Sequence[Solid], places: Places) -> Array:  # [N, L + 1]
    """The share of each lamp that each place sees, and how open its surroundings are."""
    return np.column_stack([lamps_seen(solids, places), openness(solids, places)])


def light(places: Places, reaches: Array) -> Array:  # [N, L + 1] -> [N, 3] linear RGB
    """The light on matte places: of the lamps as far as they are seen, and of the surroundings as far as they are open."""
    opened = reaches[:, -1]
    up = 0.5 + 0.5 * places.normals[:, 2:]
    total = (np.array(GROUND) + (np.array(SKY) - np.array(GROUND)) * up) * opened[:, None]
    for k, lamp in enumerate((*LAMPS, *GLOWS)):
        ways = np.array(lamp.place) - places.points
        lengths = np.sqrt(_dot(ways, ways))
        cosine = _dot(ways, places.normals) / np.maximum(lengths, 1e-6)
        strength = np.maximum((cosine + 0.25) / 1.25, 0.0) / (1.0 + (lengths / lamp.reach) ** 2)
        share = reaches[:, k] if k < len(LAMPS) else 0.4 + 0.6 * opened
        total += (strength * share)[:, None] * np.array(lamp.color)
    return total
