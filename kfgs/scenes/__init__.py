"""Scenes: posed images, points and feature maps, read from files of other programs, or estimated."""

from .extract import extract_features, save_feature_map
from .feature_maps import FeatureFolder
from .files import SceneError, list_images, read_image
from .frames import align_by_cameras
from .known_poses import find_points
from .load import load_cameras, load_scene
from .scene import Scene
from .sfm import SfmConfig, run_sfm

__all__ = [
    "FeatureFolder",
    "Scene",
    "SceneError",
    "SfmConfig",
    "align_by_cameras",
    "extract_features",
    "find_points",
    "list_images",
    "load_cameras",
    "load_scene",
    "read_image",
    "run_sfm",
    "save_feature_map",
]
