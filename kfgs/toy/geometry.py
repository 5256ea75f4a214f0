"""Boxes and ellipsoids, intersected with rays in closed form: exact depth, labels and visibility.

Everything is numpy float64 in world units (metres). The solids are the furniture of the toy room.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from .patterns import Texture

Array = NDArray[np.float64]
NEAR = 0.02  # metres: hits closer than this to a ray's origin are ignored


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


def normals(solid: Solid, points: Array) -> Array:  # [N, 3] -> [N, 3]
    """Outward unit normals at points on the surface; on an edge of a box, the normal of one face."""
    local = solid.to_local(points)
    half = np.array(solid.half)
    if solid.shape == "ellipsoid":
        n = local / half**2
        n /= np.linalg.norm(n, axis=-1, keepdims=True)
    else:
        face = np.arange(3) == np.argmax(np.abs(local) - half, axis=-1)[:, None]
        n = np.where(face, np.sign(local), 0.0)
    return n @ solid.rotation().T


def pixel_rays(camera: Camera) -> tuple[Array, Array]:  # [3], [H, W, 3]
    """Camera centre and one world direction per pixel centre, scaled so that the ray parameter is z-depth."""
    K, E = camera.K.double().numpy(), camera.viewmat.double().numpy()
    u = (np.arange(camera.width) + 0.5 - K[0, 2]) / K[0, 0]
    v = (np.arange(camera.height) + 0.5 - K[1, 2]) / K[1, 1]
    rays = np.stack([*np.meshgrid(u, v), np.ones(camera.size)], axis=-1)
    return -E[:3, :3].T @ E[:3, 3], rays @ E[:3, :3]


def project(camera: Camera, points: Array) -> tuple[Array, Array]:  # [N, 3] -> [N, 2], [N]
    """Pixels and z-depths of world points; pixels of points behind the camera are meaningless."""
    K, E = camera.K.double().numpy(), camera.viewmat.double().numpy()
    cam = points @ E[:3, :3].T + E[:3, 3]
    z = np.where(np.abs(cam[:, 2:]) < 1e-9, 1e-9, cam[:, 2:])
    return cam[:, :2] / z * np.array([K[0, 0], K[1, 1]]) + K[:2, 2], cam[:, 2]


def _window(solid: Solid, camera: Camera) -> tuple[slice, slice]:
    """The rows and columns that the solid can touch; the whole image if it reaches behind the camera."""
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    xy, z = project(camera, signs * np.array(solid.half) @ solid.rotation().T + np.array(solid.center))
    if z.min() < NEAR:
        return slice(0, camera.height), slice(0, camera.width)
    ends = np.stack([xy.min(0) - 1, xy.max(0) + 2])
    (x0, y0), (x1, y1) = np.clip(ends, 0, [camera.width, camera.height]).astype(int)
    return slice(y0, y1), slice(x0, x1)


def cast(solids: Sequence[Solid], camera: Camera) -> tuple[Array, NDArray[np.int64]]:  # [H, W], [H, W]
    """The z-depth and the index of the nearest solid at each pixel's centre (infinity and -1 where there is none)."""
    origin, rays = pixel_rays(camera)
    depth = np.full(camera.size, np.inf)
    index = np.full(camera.size, -1, np.int64)
    for i, solid in enumerate(solids):
        window = _window(solid, camera)
        t = intersect(solid, origin, rays[window])
        nearer = t < depth[window]
        depth[window][nearer] = t[nearer]
        index[window][nearer] = i
    return depth, index


def occluded(solids: Sequence[Solid], origin: Array, targets: Array) -> NDArray[np.bool_]:  # [N]
    """Whether a solid cuts the segment from `origin` to each target before its end (the last 0.1 mm do not count)."""
    ways = targets - origin
    lengths = np.maximum(np.linalg.norm(ways, axis=-1), 1e-3)
    ways /= lengths[:, None]
    to_centers = np.array([solid.center for solid in solids]) - origin
    distances = np.linalg.norm(to_centers, axis=-1)
    sines = np.minimum([np.linalg.norm(s.half) for s in solids] / np.maximum(distances, 1e-9), 1.0)
    # the cone around each solid's bounding sphere; the whole space if the origin lies inside the sphere
    in_cone = ways @ to_centers.T >= np.where(sines < 1.0, np.sqrt(1.0 - sines**2), -1.0) * distances - 1e-9
    hidden = np.zeros(len(targets), bool)
    for i, solid in enumerate(solids):
        rows = np.flatnonzero(in_cone[:, i] & ~hidden)
        hidden[rows] = intersect(solid, origin, ways[rows]) < lengths[rows] - 1e-4
    return hidden


def visible(
    solids: Sequence[Solid], camera: Camera, points: Array, outward: Array
) -> NDArray[np.bool_]:  # [N, 3], [N, 3] -> [N]
    """Which surface points (with their normals) a camera sees: inside the image, facing it, nothing in between."""
    xy, z = project(camera, points)
    E = camera.viewmat.double().numpy()
    origin = -E[:3, :3].T @ E[:3, 3]
    inside = (z > NEAR) & (xy >= 0).all(-1) & (xy < [camera.width, camera.height]).all(-1)
    rows = np.flatnonzero(inside & (((origin - points) * outward).sum(-1) > 0))
    seen = np.zeros(len(points), bool)
    seen[rows] = ~occluded(solids, origin, points[rows])
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
