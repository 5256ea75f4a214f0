"""Scores that carry the name of their protocol."""

from .label_set import LabelSet, load_label_set
from .segmentation import PROTOCOL, SegmentationReport, evaluate_segmentation, load_label_map

__all__ = ["PROTOCOL", "LabelSet", "SegmentationReport", "evaluate_segmentation", "load_label_map", "load_label_set"]
