"""Where dense features come from: the protocol of an encoder, and folders of maps that one has written."""

from .folder import FeatureFolder, save_feature_map
from .protocol import Teacher

__all__ = ["FeatureFolder", "Teacher", "save_feature_map"]
