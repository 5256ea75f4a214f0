"""Cameras along a smooth path through given cameras, at an even pace."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation, RotationSpline
from torch import Tensor

from .._check import check_size, check_whole
from .camera import Camera, at_one_origin
from .resample import fits_aspect

Array = np.ndarray[Any, Any]
SAME = 1e-9  # successive views closer than this, in position and direction, are one
STANDING = 1e-6  # of the coordinates: cameras on one tripod differ by the rounding of float32
AROUND = 3  # a closed path is continued by this many keys at both ends: keys farther away hardly change a spline


class TooFewViewsError(ValueError):
    """There are no two different views to go through."""


def path_cameras(
    cameras: Sequence[Camera],
    frames: int = 150,
    *,
    every: int = 1,
    size: tuple[int, int] | None = None,
    closed: bool = False,
) -> list[Camera]:
    """Cameras along a smooth path through given cameras (the keys), in the order given.

    Centres lie on a cubic spline and rotations on a cubic rotation spline (scipy's `RotationSpline`; kornia's
    `Quaternion.slerp` would jerk at every key). Both pass through every key. The pace is even: the time between two keys is
    hypot(distance / extent, angle / pi).

    Args:
        cameras: at least two different ones, in the order of the path (pictures of a video by name).
        frames: how many cameras to return. The first and last stand at the first and last key; a closed path ends one step
            before its start.
        every: take only every N-th camera as a key, and the last one. A hand-held video of 200 pictures trembles less with 10.
        size: (height, width) in pixels of the new cameras; None: that of the first camera. A key of another shape than the
            first stays complete, in the middle of the picture.
        closed: come back to the first camera, for a film that repeats.

    Returns:
        Pinhole cameras, `path_0000` and so on. Focal lengths and principal points change linearly between the keys.
        They have no lens distortion, and the smallest `near` of all.

    Raises:
        ValueError: if there are fewer than two different views, or a number is out of range.
    """
    from scipy.interpolate import CubicSpline  # takes a third of a second, which every command would wait

    check_whole("frames", frames, 2)
    check_whole("every", every, 1)
    if size is not None:
        check_size(size)
    keys = _keys(at_one_origin(cameras), every, closed)
    height, width = size or cameras[0].size
    keys = [_in_frame(key, *cameras[0].size).resized(height, width) for key in keys]
    places, turns = _poses(keys)
    times = np.concatenate([[0.0], np.cumsum(_steps(places, turns))])
    start, end = (times[AROUND], times[-AROUND - 1]) if closed else (times[0], times[-1])
    moments = np.linspace(start, end, frames, endpoint=not closed)
    R = RotationSpline(times, turns)(moments).as_matrix()  # [frames, 3, 3] world to camera
    t = -np.einsum("nij,nj->ni", R, CubicSpline(times, places)(moments))  # t = -R c
    lenses = np.stack([_numpy(key.K) for key in keys])[:, [0, 1, 0, 1], [0, 1, 2, 2]]  # [k, 4] fx, fy, cx, cy
    lenses = np.stack([np.interp(moments, times, column) for column in lenses.T], axis=1)
    near = min(camera.near for camera in cameras)
    path = []
    for number in range(frames):
        viewmat, K = np.eye(4), np.eye(3)
        viewmat[:3, :3], viewmat[:3, 3] = R[number], t[number]
        K[0, 0], K[1, 1], K[0, 2], K[1, 2] = lenses[number]
        name = f"path_{number:04d}"
        lens = torch.from_numpy(K), width, height
        path.append(Camera(torch.from_numpy(viewmat), *lens, name=name, near=near, origin=cameras[0].origin))
    return path


def _keys(cameras: Sequence[Camera], every: int, closed: bool) -> list[Camera]:
    """The keys, each different from the one before; those of a closed path are continued past both ends."""
    keys = [*cameras[::every]]
    if not closed and (len(cameras) - 1) % every:
        keys.append(cameras[-1])
    if len(keys) > 1:
        moved = _steps(*_poses(keys)) > SAME
        keys = [keys[0], *(key for key, new in zip(keys[1:], moved, strict=True) if new)]
    if closed and len(keys) > 1 and _steps(*_poses([keys[-1], keys[0]]))[0] <= SAME:
        keys.pop()
    if len(keys) < 2:
        raise TooFewViewsError(
            f"cameras: expected at least two different views, got {len(keys)} (of {len(cameras)}, every {every}); pass the "
            "cameras of the scene in the order of the path"
        )
    if closed:
        keys = [keys[i % len(keys)] for i in range(-AROUND, len(keys) + AROUND + 1)]
    return keys


def _in_frame(key: Camera, height: int, width: int) -> Camera:
    """The view of a portrait in the middle of a landscape, with its pixels as high as wide; others stay as they are."""
    if fits_aspect(key.size, (height, width)):
        return key
    scale = min(height / key.height, width / key.width)
    K = key.K * key.K.new_tensor([scale, scale, 1.0])[:, None]
    K[:2, 2] += key.K.new_tensor([width - scale * key.width, height - scale * key.height]) / 2
    return replace(key, K=K, width=width, height=height)


def _poses(keys: Sequence[Camera]) -> tuple[Array, Rotation]:  # [k, 3], k rotations from world to camera
    viewmats = np.stack([_numpy(key.viewmat) for key in keys])
    R, t = viewmats[:, :3, :3], viewmats[:, :3, 3]
    return -np.einsum("nji,nj->ni", R, t), Rotation.from_matrix(R)  # c = -R^T t


def _steps(places: Array, turns: Rotation) -> Array:  # [k - 1]
    """Time from each key to the next: hypot(distance / extent, angle / pi)."""
    extent = float(np.linalg.norm(np.ptp(places, axis=0)))
    if extent <= STANDING * np.abs(places).max():
        extent = 1.0
    angles = (turns[1:] * turns[:-1].inv()).magnitude()
    return np.hypot(np.linalg.norm(np.diff(places, axis=0), axis=1) / extent, angles / np.pi)


def _numpy(values: Tensor) -> Array:
    array: Array = values.detach().double().cpu().numpy()
    return array
