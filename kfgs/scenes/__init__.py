"""Scenes: posed images and points, read from files of COLMAP, nerfstudio, instant-ngp, Blender and data sets, or estimated."""

from .._files import file_stem
from ..cameras.bounds import Bounds, robust_bounds
from .colmap_model import ColmapModel, read_model
from .files import SceneError, list_images, read_image
from .known_poses import find_points, write_known_poses
from .load import is_scene, load_cameras, load_scene
from .pictures import convert_heic, extract_frames
from .scene import Scene
from .sfm import SfmConfig, link_images, run_sfm
from .sfm_onto import extend_sfm
from .splits import make_split
from .undistort import undistort_scene

__all__ = [
    "Bounds",
    "ColmapModel",
    "Scene",
    "SceneError",
    "SfmConfig",
    "convert_heic",
    "extend_sfm",
    "extract_frames",
    "file_stem",
    "find_points",
    "is_scene",
    "link_images",
    "list_images",
    "load_cameras",
    "load_scene",
    "make_split",
    "read_image",
    "read_model",
    "robust_bounds",
    "run_sfm",
    "undistort_scene",
    "write_known_poses",
]
