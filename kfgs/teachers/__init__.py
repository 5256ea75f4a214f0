"""Where dense features come from: encoders, and folders of maps that one has written."""

from .cache import Picture, discard_maps, extract_features, pictures_of
from .folder import FeatureFolder, save_feature_map
from .load import load_teacher, teacher_names
from .manifest import Manifest, read_manifest
from .prompts import TEMPLATES, embed_labels, make_label_set
from .protocol import CallableTeacher, Teacher, as_teacher, identify
from .recompute import RecomputedMaps
from .report import FeatureReport, check_feature_folder

__all__ = [
    "TEMPLATES",
    "CallableTeacher",
    "FeatureFolder",
    "FeatureReport",
    "Manifest",
    "Picture",
    "RecomputedMaps",
    "Teacher",
    "as_teacher",
    "check_feature_folder",
    "discard_maps",
    "embed_labels",
    "extract_features",
    "identify",
    "load_teacher",
    "make_label_set",
    "pictures_of",
    "read_manifest",
    "save_feature_map",
    "teacher_names",
]
