"""Scenes: posed images, points and feature maps, read from files of other programs, or estimated."""

from .extract import Picture, extract_features, pictures_of
from .feature_files import save_feature_map
from .feature_maps import FeatureFolder
from .files import SceneError, list_images, read_image
from .frames import Alignment, align_by_cameras, frames_agree
from .known_poses import find_points, write_known_poses
from .load import is_scene, load_cameras, load_scene
from .pictures import convert_heic, extract_frames
from .scene import Scene
from .sfm import SfmConfig, link_images, run_sfm
from .splits import make_split
from .undistort import undistort_scene

__all__ = [
    "Alignment",
    "FeatureFolder",
    "Picture",
    "Scene",
    "SceneError",
    "SfmConfig",
    "align_by_cameras",
    "convert_heic",
    "extract_features",
    "extract_frames",
    "find_points",
    "frames_agree",
    "is_scene",
    "link_images",
    "list_images",
    "load_cameras",
    "load_scene",
    "make_split",
    "pictures_of",
    "read_image",
    "run_sfm",
    "save_feature_map",
    "undistort_scene",
    "write_known_poses",
]
