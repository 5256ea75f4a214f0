"""Scenes: posed images and points, read from files of COLMAP, nerfstudio, instant-ngp, Blender and data sets, or estimated."""

from ..cameras.bounds import Bounds, robust_bounds
from .colmap import load_colmap
from .colmap_model import ColmapModel, read_model
from .files import SceneError, file_stem, list_images, natural_key, read_image
from .llff import load_llff
from .load import load_scene
from .replica import load_nice_slam, load_semantic_nerf
from .scannet import load_scannet
from .scene import Scene
from .sfm import SfmConfig, SfmReport, run_sfm
from .splits import make_split, read_split, split_every
from .transforms import load_transforms
from .undistort import undistort_scene

__all__ = [
    "Bounds",
    "ColmapModel",
    "Scene",
    "SceneError",
    "SfmConfig",
    "SfmReport",
    "file_stem",
    "list_images",
    "load_colmap",
    "load_llff",
    "load_nice_slam",
    "load_scannet",
    "load_scene",
    "load_semantic_nerf",
    "load_transforms",
    "make_split",
    "natural_key",
    "read_image",
    "read_model",
    "read_split",
    "robust_bounds",
    "run_sfm",
    "split_every",
    "undistort_scene",
]
