"""Where dense features come from: encoders, and folders of maps that one has written."""

from .folder import FeatureFolder, save_feature_map
from .manifest import Manifest, read_manifest
from .protocol import CallableTeacher, Teacher, as_teacher, identify

__all__ = [
    "CallableTeacher",
    "FeatureFolder",
    "Manifest",
    "Teacher",
    "as_teacher",
    "identify",
    "read_manifest",
    "save_feature_map",
]
