"""The camera of one frame of a transforms.json.

**Convention**: `transform_matrix` is camera to world with OpenGL axes (x right, y up, z backward). kfgs wants world to
camera with y down and z forward, so the y and z columns change sign and the pose is inverted. World coordinates are those of
the file: `applied_transform`, which was applied to poses and points, is not undone.
`cx, cy` are read as in COLMAP (the centre of the first pixel is (0.5, 0.5)), because the converters of nerfstudio and
instant-ngp copy COLMAP's numbers and both programs sample pixels at +0.5.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..cameras.camera import Distortion
from .colmap import PANORAMA
from .files import MAX_NUMBER, MAX_SIDE, SceneError
from .posed import Matrix

_LENSES = {  # the coefficients that each camera_model has
    **dict.fromkeys(("PINHOLE", "SIMPLE_PINHOLE"), ()),
    **dict.fromkeys(("OPENCV_FISHEYE", "FISHEYE"), ("k1", "k2", "k3", "k4")),
    **dict.fromkeys(("PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"), ("k1", "k2", "p1", "p2", "k3")),
    "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
_COEFFICIENTS = _LENSES["FULL_OPENCV"]
_NUMBERS = ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y", *_COEFFICIENTS)
_CORRECT = "correct it, or take the frame out of the file"
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL axes to COLMAP's


@dataclass(frozen=True)
class Frame:
    """The values of one frame; if the frame lacks one, that at the top of the file."""

    path: Path
    where: str
    values: dict[str, Any]

    def fail(self, where: str, expected: str, got: object, advice: str) -> SceneError:
        """An error that names the file, the frame and the place in it."""
        place = f"{self.where}, {where}" if where else self.where
        return SceneError(f"{self.path}, {place}: expected {expected}, got {got!r:.200}; {advice}")

    def number(self, name: str, default: float | None = None) -> float:
        """A finite number of the frame; a SceneError if it is something else, or missing without a default."""
        value = self.values.get(name, default)
        if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) < MAX_NUMBER:
            raise self.fail(name, "a finite number", value, "add it at the top or in each frame")
        return float(value)

    @property
    def broken(self) -> bool:
        """Whether its pose is missing, or a number of it or of the lens is NaN, infinite or implausible."""
        rows = self.values.get("transform_matrix")
        numbers = [self.values.get(name) for name in _NUMBERS]
        numbers += [number for row in rows if isinstance(row, list) for number in row] if isinstance(rows, list) else []
        return rows is None or any(isinstance(n, float) and not abs(n) < MAX_NUMBER for n in numbers)

    def lens(self) -> tuple[Matrix, tuple[int, int]]:
        """K [3, 3], and (width, height) in pixels."""
        width, height = self.number("w"), self.number("h")
        if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE and width % 1 == 0 and height % 1 == 0):
            raise self.fail("", f"w and h of 1 to {MAX_SIDE} whole pixels", (width, height), "correct the size")
        fx, fy = self.focal_length("x", width), self.focal_length("y", height)
        if fx is None:
            expected = "'fl_x' or 'camera_angle_x'"
            raise self.fail("", expected, sorted(self.values), "add one at the top or in each frame")
        cx, cy = self.number("cx", width / 2), self.number("cy", height / 2)
        return np.array([[fx, 0, cx], [0, fx if fy is None else fy, cy], [0, 0, 1]]), (int(width), int(height))

    def focal_length(self, axis: str, side: float) -> float | None:
        """The focal length in pixels along x or y, also from the angle of view; None if the frame has neither."""
        if f"fl_{axis}" in self.values:
            return self.number(f"fl_{axis}")
        name = f"camera_angle_{axis}"
        if name not in self.values:
            return None
        angle = self.number(name)
        if not 0 < angle < math.pi:
            raise self.fail(name, "an angle in (0, pi) radians", angle, "correct it")
        return side / 2 / math.tan(angle / 2)

    def distortion(self) -> Distortion | None:
        """The lens; a perspective lens whose coefficients are all zero is None.

        The k4 of nerfstudio's perspective camera is the fourth radial term; OpenCV's k4 is the first of the denominator. So
        k4 is accepted only with FULL_OPENCV, where it can only mean OpenCV's.
        """
        model = "OPENCV_FISHEYE" if self.values.get("is_fisheye") is True else self.values.get("camera_model", "OPENCV")
        if model not in _LENSES:
            advice = PANORAMA if model == "EQUIRECTANGULAR" else "undistort the images first"
            raise self.fail("camera_model", f"one of {', '.join(_LENSES)}", model, advice)
        values, known = {name: self.number(name, 0.0) for name in _COEFFICIENTS}, _LENSES[model]
        other = {name: value for name, value in values.items() if value and name not in known}
        if other:
            expected = f"only {' '.join(known) or 'zeros'} with camera_model {model}"
            advice = 'correct camera_model ("FULL_OPENCV" for OpenCV\'s k4 k5 k6), or undistort the images first'
            raise self.fail("", expected, other, advice)
        coefficients = tuple(values[name] for name in known)
        if "FISHEYE" in model:
            return Distortion("kannala_brandt", coefficients)
        if not any(coefficients):
            return None
        used = next(n for n in (4, 5, 8) if not any(coefficients[n:]))  # as few as kornia and OpenCV need
        return Distortion("brown_conrady", coefficients[:used])

    def pose(self) -> Matrix:  # [4, 4] float64
        """Camera to world, x right, y down, z forward."""
        name, rows = "transform_matrix", self.values.get("transform_matrix")
        try:
            pose = np.array(rows, dtype=np.float64)
            if pose.shape == (3, 4):
                pose = np.concatenate([pose, [[0.0, 0.0, 0.0, 1.0]]])
            if pose.shape != (4, 4):
                raise ValueError(f"shape {pose.shape}")
        except (TypeError, ValueError, OverflowError) as error:
            raise self.fail(name, "4 rows of 4 numbers", rows, _CORRECT) from error
        if not np.allclose(pose[3], [0, 0, 0, 1], rtol=0, atol=1e-6):
            advice = "transpose the matrix, if its last column is 0 0 0 1"
            raise self.fail(name, "0 0 0 1 as the last row", pose[3].tolist(), advice)
        return pose @ FLIP
