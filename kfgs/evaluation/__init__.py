"""Scores that carry the name of their protocol."""

from .color import score_views
from .find import find_labels, find_points
from .label_pictures import load_label_map
from .method import FieldMethod, Labeller, Method, TeacherMethod, View, label_view
from .protocols import PROTOCOLS, KfgsColor, KfgsPooled, KfgsSurface, get_protocol
from .report import Report
from .segmentation import SegmentationReport, evaluate_segmentation
from .surface import score_surface
from .teacher_agreement import TeacherAgreement
from .truth import LabelTruth, PointTruth
from .views import label_views

__all__ = [
    "PROTOCOLS",
    "FieldMethod",
    "KfgsColor",
    "KfgsPooled",
    "KfgsSurface",
    "LabelTruth",
    "Labeller",
    "Method",
    "PointTruth",
    "Report",
    "SegmentationReport",
    "TeacherAgreement",
    "TeacherMethod",
    "View",
    "evaluate_segmentation",
    "find_labels",
    "find_points",
    "get_protocol",
    "label_view",
    "label_views",
    "load_label_map",
    "score_surface",
    "score_views",
]
