"""Posed cameras, paths of cameras, projection, lens distortion and resampling, carried by kornia."""

from .camera import Camera, Distortion
from .paths import Orbit, estimate_up, orbit_cameras, path_cameras, robust_bounds
from .projection import Cameras as Cameras
from .projection import as_cameras as as_cameras
from .projection import from_kornia, project_points, to_kornia
from .resample import from_bchw, resize_map, to_bchw, undistort
from .similarity import Similarity

__all__ = [
    "Camera",
    "Distortion",
    "Orbit",
    "Similarity",
    "estimate_up",
    "from_bchw",
    "from_kornia",
    "orbit_cameras",
    "path_cameras",
    "project_points",
    "resize_map",
    "robust_bounds",
    "to_bchw",
    "to_kornia",
    "undistort",
]
