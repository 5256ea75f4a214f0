"""Cameras that walk around the toy room, and its pictures: colour, exact z-depth and exact labels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ..cameras.camera import Camera
from .geometry import Array, Solid, cast, normals, pixel_rays
from .light import lamps_seen, light, openness
from .patterns import Noise, evaluate
from .room import CLASSES

_SPLIT = 2  # colour samples per pixel and axis
_EXPOSURE = 1.4


class View(NamedTuple):
    """One rendered view."""

    image: NDArray[np.uint8]  # [H, W, 3]
    depth: Array  # [H, W] z-depth at the pixel's centre, metres
    labels: NDArray[np.uint8]  # [H, W] class index


def walk_cameras(train_views: int, test_views: int, size: tuple[int, int]) -> tuple[list[Camera], list[bool]]:
    """Cameras in the order of the walk, named `view_000.png` and so on, and which of them are for testing.

    Training cameras divide the walk evenly; each test camera stands between two of them, in the middle. The walk goes around
    the room twice, first high and looking up, then low and looking down, so that most surfaces are seen often. Pictures are
    71 degrees wide; fx != fy, and the principal point is off the centre, so that code that assumes otherwise fails visibly.
    """
    height, width = size
    unit, fx = width / 256.0, 180.0 * (width / 256.0)
    K = [[fx, 0, width / 2 + 3.5 * unit], [0, 1.02 * fx, height / 2 - 2.5 * unit], [0, 0, 1]]
    steps = [(i / train_views, False) for i in range(train_views)]
    steps += [((j * train_views // test_views + 0.5) / train_views, True) for j in range(test_views)]
    cameras = []
    for number, (turn, _) in enumerate(sorted(steps)):
        a = 4 * np.pi * turn
        lift = np.sin(a / 2)  # above 0 in the first round, below in the second
        position = np.array([2.15 * np.cos(a), 1.75 * np.sin(a), 1.5 + 0.2 * np.sin(3 * a + 0.5) + 0.25 * lift])
        aim = 1.0 + 0.3 * np.sin(2 * a + 0.4) + 0.95 * lift  # its height
        target = np.array([0.55 * np.cos(2 * a + 1.0), 0.45 * np.sin(3 * a), aim])
        ahead = target - 0.35 * position * [1, 1, 0] - position
        forward, roll = ahead / np.linalg.norm(ahead), 0.05 * float(np.sin(5 * a))
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        down = np.cross(forward, right)
        c, s = np.cos(roll), np.sin(roll)
        viewmat = np.eye(4)
        viewmat[:3, :3] = np.stack([c * right + s * down, c * down - s * right, forward])
        viewmat[:3, 3] = -viewmat[:3, :3] @ position
        name = f"view_{number:03d}.png"
        cameras.append(Camera(torch.from_numpy(viewmat), torch.tensor(K, dtype=torch.float64), width, height, name))
    return cameras, [test for _, test in sorted(steps)]


def surface_color(
    solids: Sequence[Solid],
    noise: Noise,
    points: Array,  # [N, 3]
    outward: Array,  # [N, 3] unit normals
    which: NDArray[np.int64],  # [N]
    footprint: Array,  # [N] metres a pixel covers
    lit: Array,  # [N, L + 1] from `light_reaches`
) -> Array:  # [N, 3] in [0, 1]
    """Material times the light on it, as a matte surface shows it; it does not depend on the camera."""
    color = np.zeros((len(points), 3))
    for i in np.unique(which):
        rows = np.flatnonzero(which == i)
        solid, p, n = solids[i], points[rows], outward[rows]
        axis = np.argmax(np.abs(n @ solid.rotation()), axis=-1)
        is_round = solid.shape == "ellipsoid"
        local, half = solid.to_local(p), np.array(solid.half)
        own = evaluate(solid.texture, noise, local, axis, half, footprint[rows], is_round=is_round)
        bright = light(p, n, lit[rows, :-1], lit[rows, -1]) + solid.texture.glow
        color[rows] = np.square(np.clip(own, 0.0, 1.0)) * bright  # light multiplies linear values, about squares
    return np.sqrt(-np.expm1(-_EXPOSURE * color))  # bright places turn white slowly, as on film


def light_reaches(
    solids: Sequence[Solid], points: Array, outward: Array, which: NDArray[np.int64]
) -> Array:  # [N, 3], [N, 3], [N] -> [N, L + 1]
    """The share of each lamp that each point sees, and how open its surroundings are."""
    opened = openness(solids, points, outward, which)
    return np.column_stack([lamps_seen(solids, points, outward, which), opened])


def _normals(solids: Sequence[Solid], points: Array, which: NDArray[np.int64]) -> Array:  # [N, 3], [N] -> [N, 3]
    outward = np.zeros_like(points)
    for i in np.unique(which):
        outward[which == i] = normals(solids[i], points[which == i])
    return outward


def render(solids: Sequence[Solid], noise: Noise, camera: Camera) -> View:
    """Render one view: depth and labels at pixel centres, colour averaged over 2 x 2 samples per pixel."""
    depth, index = cast(solids, camera)
    assert np.isfinite(depth).all(), "the room is closed"
    origin, rays = pixel_rays(camera)
    points, which = (origin + rays * depth[..., None]).reshape(-1, 3), index.ravel()
    shares = light_reaches(solids, points, _normals(solids, points, which), which)
    lit = shares.reshape(*camera.size, -1).repeat(_SPLIT, axis=0).repeat(_SPLIT, axis=1).reshape(-1, shares.shape[-1])

    fine = camera.resized(camera.height * _SPLIT, camera.width * _SPLIT)
    fine_depth, fine_index = cast(solids, fine)
    points, which = (origin + pixel_rays(fine)[1] * fine_depth[..., None]).reshape(-1, 3), fine_index.ravel()
    footprint = (fine_depth / float(camera.K[0, 0])).ravel()
    color = surface_color(solids, noise, points, _normals(solids, points, which), which, footprint, lit)
    color = color.reshape(camera.height, _SPLIT, camera.width, _SPLIT, 3).mean((1, 3))
    classes = np.array([CLASSES.index(solid.label) for solid in solids], np.uint8)
    return View(np.round(color * 255).astype(np.uint8), depth, classes[index])
