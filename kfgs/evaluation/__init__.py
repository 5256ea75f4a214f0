"""Scores that carry the name of their protocol."""

from ..labels.label_set import LabelSet, load_label_set
from .color import score_views
from .editing import score_recolor, score_removal
from .segmentation import SegmentationReport, evaluate_segmentation, load_label_map
from .surface_density import surface_density

__all__ = [
    "LabelSet",
    "SegmentationReport",
    "evaluate_segmentation",
    "load_label_map",
    "load_label_set",
    "score_recolor",
    "score_removal",
    "score_views",
    "surface_density",
]
