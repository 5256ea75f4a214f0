"""Scores that carry the name of their protocol."""

from .color import score_views
from .find import find_labels, find_points
from .method import FieldMethod, Method, TeacherMethod, View, label_view
from .protocols import get_protocol
from .report import Report
from .segmentation import evaluate_segmentation
from .truth import LabelTruth
from .views import label_views

__all__ = [
    "FieldMethod",
    "LabelTruth",
    "Method",
    "Report",
    "TeacherMethod",
    "View",
    "evaluate_segmentation",
    "find_labels",
    "find_points",
    "get_protocol",
    "label_view",
    "label_views",
    "score_views",
]
