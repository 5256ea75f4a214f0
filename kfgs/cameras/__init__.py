"""Posed cameras, paths of cameras, projection, lens distortion and resampling, carried by kornia."""

from .bounds import robust_bounds
from .camera import Camera, Distortion
from .kornia_camera import from_kornia, to_kornia
from .paths import Orbit, estimate_up, orbit_cameras, path_cameras
from .projection import camera_to_pixel, project_points, projection_jacobian, unproject_depth, world_to_camera
from .resample import resize_labels, resize_map
from .similarity import Similarity, fit_similarity
from .undistort import undistort, undistort_labels

__all__ = [
    "Camera",
    "Distortion",
    "Orbit",
    "Similarity",
    "camera_to_pixel",
    "estimate_up",
    "fit_similarity",
    "from_kornia",
    "orbit_cameras",
    "path_cameras",
    "project_points",
    "projection_jacobian",
    "resize_labels",
    "resize_map",
    "robust_bounds",
    "to_kornia",
    "undistort",
    "undistort_labels",
    "unproject_depth",
    "world_to_camera",
]
