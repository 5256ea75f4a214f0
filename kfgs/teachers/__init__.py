"""Where dense features come from: encoders, and folders of maps that one has written."""

from .bpe import Tokenizer, load_tokenizer
from .cache import Picture, check_discardable, discard_maps, extract_features, pictures_of
from .checkpoint import read_checkpoint, weights_digest
from .costs import TeacherCost, teacher_cost
from .folder import FeatureFolder, save_feature_map
from .layouts import write_npy_map
from .load import load_teacher, teacher_names
from .lseg import LSeg, LSegConfig, LSegOptions, load_lseg
from .manifest import Manifest, MapRecord, read_manifest
from .prompts import TEMPLATES, embed_labels, make_label_set
from .protocol import CallableTeacher, Teacher, as_teacher, identify
from .recompute import RecomputedMaps
from .report import FeatureReport, check_feature_folder
from .sam import SamTeacher, load_sam
from .transformers_table import TRANSFORMERS
from .transformers_teacher import TransformersTeacher, load_transformers_teacher

__all__ = [
    "TEMPLATES",
    "TRANSFORMERS",
    "CallableTeacher",
    "FeatureFolder",
    "FeatureReport",
    "LSeg",
    "LSegConfig",
    "LSegOptions",
    "Manifest",
    "MapRecord",
    "Picture",
    "RecomputedMaps",
    "SamTeacher",
    "Teacher",
    "TeacherCost",
    "Tokenizer",
    "TransformersTeacher",
    "as_teacher",
    "check_discardable",
    "check_feature_folder",
    "discard_maps",
    "embed_labels",
    "extract_features",
    "identify",
    "load_lseg",
    "load_sam",
    "load_teacher",
    "load_tokenizer",
    "load_transformers_teacher",
    "make_label_set",
    "pictures_of",
    "read_checkpoint",
    "read_manifest",
    "save_feature_map",
    "teacher_cost",
    "teacher_names",
    "weights_digest",
    "write_npy_map",
]
