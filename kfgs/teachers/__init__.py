"""Where dense features come from: encoders, and folders of maps that one has written."""

from .bpe import Tokenizer, load_tokenizer
from .cache import Picture, discard_maps, extract_features, pictures_of
from .checkpoint import read_checkpoint
from .costs import TeacherCost, teacher_cost
from .folder import FeatureFolder, save_feature_map
from .layouts import write_npy_map
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
    "TeacherCost",
    "Tokenizer",
    "as_teacher",
    "check_feature_folder",
    "discard_maps",
    "embed_labels",
    "extract_features",
    "identify",
    "load_teacher",
    "load_tokenizer",
    "make_label_set",
    "pictures_of",
    "read_checkpoint",
    "read_manifest",
    "save_feature_map",
    "teacher_cost",
    "teacher_names",
    "write_npy_map",
]
