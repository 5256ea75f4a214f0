"""Feature maps on disk: written by a teacher, or found as other programs left them."""

from .extract import discard_maps, extract_features, join_features
from .folder import FeatureFolder
from .layouts import save_feature_map, write_npy_map
from .manifest import read_manifest
from .pictures import Picture, pictures_of
from .recompute import RecomputedMaps

__all__ = [
    "FeatureFolder",
    "Picture",
    "RecomputedMaps",
    "discard_maps",
    "extract_features",
    "join_features",
    "pictures_of",
    "read_manifest",
    "save_feature_map",
    "write_npy_map",
]
