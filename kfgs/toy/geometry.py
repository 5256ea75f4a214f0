"""Boxes and ellipsoids, intersected with rays in closed form: exact depth, labels and visibility.

Everything is numpy float64 in world units (metres). The solids are the furniture of the toy room.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..cameras.projection import project_points

Array = NDArray[np.float64]
NEAR = 0.02  # metres: hits closer than this to a ray's origin are ignored


@dataclass(frozen=True)
class Texture:
    """The material of one object: its pattern, two or more colours (RGB in [0, 1]), its size in metres, its seed."""

    kind: str  # a name of PATTERNS
    colors: tuple[tuple[float, float, float], ...]
    scale: float = 0.2
    seed: int = 0
    contrast: float = 0.1  # of the fine noise on top, relative to the colour
    glow: float = 0.0  # light that it gives off by itself: a lamp's shade


@dataclass(frozen=True)
class Solid:
    """A box or ellipsoid: `half` are half edges or radii along its axes, which are turned by `yaw` about z."""

    shape: Literal["box", "ellipsoid"]
    center: tuple[float, float, float]
    half: tuple[float, float, float]
    yaw: float  # radians, counter-clockwise seen from above
    label: str
    texture: Texture

    def rotation(self) -> Array:  # [3, 3]
        """Local to world."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def to_local(self, points: Array) -> Array:  # [..., 3] -> [..., 3]
        """World points in the axes of the solid, around its centre."""
        return (points - np.array(self.center)) @ self.rotation()

    def area(self) -> float:
        """Surface area, square metres (Thomsen's approximation for an ellipsoid, within 1.1 %)."""
        a, b, c = self.half
        if self.shape == "box":
            return 8.0 * (a * b + b * c + c * a)
        p = 1.6075
        return float(4.0 * np.pi * (((a * b) ** p + (b * c) ** p + (c * a) ** p) / 3.0) ** (1.0 / p))


def intersect(solid: Solid, origin: Array, directions: Array) -> Array:  # [3], [..., 3] -> [...]
    """The parameter t at which `origin + t * directions` enters the solid; infinity if it misses."""
    o = solid.to_local(origin)
    d = directions @ solid.rotation() if solid.yaw else directions
    if solid.shape == "ellipsoid":
        o, d = o / np.array(solid.half), d / np.array(solid.half)
        a, b, c = np.einsum("...i,...i", d, d), d @ o, float(o @ o) - 1.0
        root = b * b - a * c
        t = (-b - np.sqrt(np.maximum(root, 0.0))) / a
        return np.where((root > 0) & (t > NEAR), t, np.inf)
    enter, leave = np.full(d.shape[:-1], -np.inf), np.full(d.shape[:-1], np.inf)
    for axis in range(3):
        inverse = 1.0 / np.where(np.abs(d[..., axis]) < 1e-12, 1e-12, d[..., axis])
        middle, reach = inverse * -o[axis], np.abs(inverse) * solid.half[axis]
        enter, leave = np.maximum(enter, middle - reach), np.minimum(leave, middle + reach)
    return np.where((enter <= leave) & (enter > NEAR), enter, np.inf)


class Places(NamedTuple):
    """Places on the surfaces of solids."""

    points: Array  # [N, 3] world
    normals: Array  # [N, 3] unit length, outward
    which: NDArray[np.int64]  # [N] the solid of each

    def take(self, rows: NDArray[np.int64]) -> Places:
        """Some of the places."""
        return Places(self.points[rows], self.normals[rows], self.which[rows])


def places_on(solids: Sequence[Solid], points: Array, which: NDArray[np.int64]) -> Places:  # [N, 3], [N]
    """Points on the surfaces of the given solids with their normals; on an edge of a box, the normal of one face."""
    outward = np.zeros_like(points)
    for i in np.unique(which):
        rows, solid, half = which == i, solids[i], np.array(solids[i].half)
        local = solid.to_local(points[rows])
        if solid.shape == "ellipsoid":
            n = local / half**2
            n /= np.linalg.norm(n, axis=-1, keepdims=True)
        else:
            face = np.arange(3) == np.argmax(np.abs(local) - half, axis=-1)[:, None]
            n = np.where(face, np.sign(local), 0.0)
        outward[rows] = n @ solid.rotation().T
    return Places(points, outward, which)


def in_cone(solid: Solid, origin: Array, ways: Array, margin: float = 0.0) -> NDArray[np.bool_]:  # [N, 3] -> [N]
    """Which unit vectors from `origin` may touch the ball around a solid, made larger by `margin`; all from inside it."""
    to_center = np.array(solid.center) - origin
    outside = float(to_center @ to_center) - (float(np.linalg.norm(solid.half)) + margin) ** 2
    return ways @ to_center > np.sqrt(outside) - 1e-9 if outside > 0 else np.ones(len(ways), bool)


def first_hit(solids: Sequence[Solid], origin: Array, directions: Array) -> tuple[Array, NDArray[np.int64]]:
    """Where each ray [N, 3] first enters a solid, and which: `intersect`'s parameter and the index (infinity and -1)."""
    ways = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    nearest, which = np.full(len(ways), np.inf), np.full(len(ways), -1)
    for i, solid in enumerate(solids):
        rows = np.flatnonzero(in_cone(solid, origin, ways))
        t = intersect(solid, origin, directions[rows])
        nearer = t < nearest[rows]
        nearest[rows[nearer]], which[rows[nearer]] = t[nearer], i
    return nearest, which


def cast(solids: Sequence[Solid], camera: Camera) -> tuple[Array, Places]:  # [H, W], H * W places
    """What a camera sees at its pixels' centres in a closed room: the z-depths, and the places row by row."""
    origin, K, E = camera.center.numpy(), camera.K.numpy(), camera.viewmat.numpy()
    u = (np.arange(camera.width) + 0.5 - K[0, 2]) / K[0, 0]
    v = (np.arange(camera.height) + 0.5 - K[1, 2]) / K[1, 1]
    rays = (np.stack([*np.meshgrid(u, v), np.ones(camera.size)], axis=-1) @ E[:3, :3]).reshape(-1, 3)  # 1 long along z
    depth, which = first_hit(solids, origin, rays)
    assert np.isfinite(depth).all(), "the room is closed"
    return depth.reshape(camera.size), places_on(solids, origin + rays * depth[:, None], which)


def visible(solids: Sequence[Solid], camera: Camera, places: Places) -> NDArray[np.bool_]:  # [N]
    """Which places a camera sees: inside the image, facing it, and no solid cuts the way to them, but for its last 0.1 mm."""
    origin = camera.center.numpy()
    seen = project_points(camera, torch.from_numpy(places.points), near=NEAR)[2].numpy()
    seen &= ((origin - places.points) * places.normals).sum(-1) > 0
    ways = places.points[seen] - origin
    lengths = np.linalg.norm(ways, axis=-1)
    seen[seen] = first_hit(solids, origin, ways / lengths[:, None])[0] >= lengths - 1e-4
    return seen


def sample_surface(solid: Solid, count: int, rng: np.random.Generator) -> Array:  # [count, 3]
    """Points drawn uniformly by area on the whole surface of a solid."""
    half = np.array(solid.half)
    if solid.shape == "box":
        faces = np.array([half[1] * half[2], half[2] * half[0], half[0] * half[1]])
        axis = rng.choice(3, size=count, p=faces / faces.sum())
        local = rng.uniform(-1.0, 1.0, (count, 3)) * half
        local[np.arange(count), axis] = half[axis] * rng.choice([-1.0, 1.0], size=count)
    else:
        parts: list[Array] = [np.empty((0, 3))]
        while sum(map(len, parts)) < count:  # reject by the area element of the map from the unit sphere
            u = rng.standard_normal((2 * count + 16, 3))
            u /= np.linalg.norm(u, axis=-1, keepdims=True)
            parts.append((u * half)[rng.random(len(u)) < np.linalg.norm(u / half, axis=-1) * half.min()])
        local = np.concatenate(parts)[:count]
    return local @ solid.rotation().T + np.array(solid.center)
