"""Scores that carry the name of their protocol."""

from ..labels.label_set import LabelSet, load_label_set
from .color import ColorReport, score_views
from .editing import RecolorReport, RemovalReport, score_recolor, score_removal
from .method import FieldMethod, Labeller, Method, TeacherMethod, View, best_labels, label_view
from .report import Report
from .segmentation import PROTOCOL, SegmentationReport, evaluate_segmentation, load_label_map
from .surface_density import surface_density
from .truth import LabelTruth, MaskAndBoxes, MaskTruth, PointTruth

__all__ = [
    "PROTOCOL",
    "ColorReport",
    "FieldMethod",
    "LabelSet",
    "LabelTruth",
    "Labeller",
    "MaskAndBoxes",
    "MaskTruth",
    "Method",
    "PointTruth",
    "RecolorReport",
    "RemovalReport",
    "Report",
    "SegmentationReport",
    "TeacherMethod",
    "View",
    "best_labels",
    "evaluate_segmentation",
    "label_view",
    "load_label_map",
    "load_label_set",
    "score_recolor",
    "score_removal",
    "score_views",
    "surface_density",
]
