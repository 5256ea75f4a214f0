"""Posed cameras, paths of cameras, projection, lens distortion and resampling, carried by kornia."""

from .camera import Camera, Distortion
from .paths import Orbit, estimate_up, orbit_cameras, path_cameras, robust_bounds
from .projection import from_kornia, project_points, to_kornia
from .resample import resize_map, undistort
from .similarity import Similarity, fit_similarity

__all__ = [
    "Camera",
    "Distortion",
    "Orbit",
    "Similarity",
    "estimate_up",
    "fit_similarity",
    "from_kornia",
    "orbit_cameras",
    "path_cameras",
    "project_points",
    "resize_map",
    "robust_bounds",
    "to_kornia",
    "undistort",
]
