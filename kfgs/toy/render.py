"""Cameras that walk around the toy room, and its pictures: colour, exact z-depth and exact labels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from ..cameras.camera import Camera
from .geometry import Array, Places, Solid, cast
from .light import light, light_reaches
from .patterns import Noise, evaluate
from .room import CLASSES

_SPLIT = 2  # colour samples per pixel and axis
_EXPOSURE = 1.4


def walk_cameras(train_views: int, test_views: int, size: tuple[int, int]) -> tuple[list[Camera], NDArray[np.bool_]]:
    """Cameras in the order of the walk, named `view_000.png` and so on, and which of them are for testing.

    Training cameras divide the walk evenly; each test camera stands between two of them, in the middle. The walk goes around
    the room twice, first high and looking up, then low and looking down, so that most surfaces are seen often. Pictures are
    71 degrees wide; fx != fy, and the principal point is off the centre, so that code that assumes otherwise fails visibly.
    """
    height, width = size
    unit, fx = width / 256.0, 180.0 * (width / 256.0)
    K = np.array([[fx, 0, width / 2 + 3.5 * unit], [0, 1.02 * fx, height / 2 - 2.5 * unit], [0, 0, 1]])
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
        cameras.append(Camera(torch.from_numpy(viewmat), torch.from_numpy(K), width, height, name))
    return cameras, np.array([test for _, test in sorted(steps)])


def surface_color(solids: Sequence[Solid], noise: Noise, places: Places, footprint: Array, reaches: Array) -> Array:
    """Material times the light on it, as a matte surface shows it, [N, 3] in [0, 1]; it does not depend on the camera.

    A pixel covers `footprint` metres [N] of the surface; `reaches` [N, L + 1] is what `light_reaches` says of the places.
    """
    bright, color = light(places, reaches), np.zeros((len(footprint), 3))
    for i in np.unique(places.which):
        rows = np.flatnonzero(places.which == i)
        own = evaluate(solids[i], noise, places.take(rows), footprint[rows])
        glow = solids[i].texture.glow
        color[rows] = np.square(np.clip(own, 0.0, 1.0)) * (bright[rows] + glow)  # linear values are about squares
    return np.sqrt(-np.expm1(-_EXPOSURE * color))  # bright places turn white slowly, as on film


def render(
    solids: Sequence[Solid], noise: Noise, camera: Camera
) -> tuple[NDArray[np.uint8], Array, NDArray[np.uint8]]:  # [H, W, 3], [H, W], [H, W]
    """Render one view: RGB as the mean of 2 x 2 samples per pixel, and z-depth (metres) and class at its centre."""
    depth, places = cast(solids, camera)
    coarse = light_reaches(solids, places).reshape(*camera.size, -1)
    reaches = coarse.repeat(_SPLIT, axis=0).repeat(_SPLIT, axis=1).reshape(-1, coarse.shape[-1])
    fine_depth, fine_places = cast(solids, camera.resized(camera.height * _SPLIT, camera.width * _SPLIT))
    footprint = (fine_depth / float(camera.K[0, 0])).ravel()
    color = surface_color(solids, noise, fine_places, footprint, reaches)
    color = color.reshape(camera.height, _SPLIT, camera.width, _SPLIT, 3).mean((1, 3))
    labels = np.array([CLASSES.index(solid.label) for solid in solids], np.uint8)[places.which]
    return np.round(color * 255).astype(np.uint8), depth, labels.reshape(camera.size)
