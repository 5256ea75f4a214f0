"""Feature maps on disk: written by a teacher, or found as other programs left them."""

from .extract import Picture, check_discardable, discard_maps, extract_features, pictures_of
from .folder import FeatureFolder, save_feature_map
from .layouts import write_npy_map
from .manifest import Manifest, MapRecord, read_manifest
from .recompute import RecomputedMaps
from .report import FeatureReport, check_feature_folder

__all__ = [
    "FeatureFolder",
    "FeatureReport",
    "Manifest",
    "MapRecord",
    "Picture",
    "RecomputedMaps",
    "check_discardable",
    "check_feature_folder",
    "discard_maps",
    "extract_features",
    "pictures_of",
    "read_manifest",
    "save_feature_map",
    "write_npy_map",
]
