"""Scores that carry the name of their protocol."""

from ..labels.label_set import LabelSet, load_label_set
from .class_lists import load_classes
from .color import score_views
from .editing import score_recolor, score_removal
from .legaussians_masks import LEGaussiansMasks
from .lerf_2d import LerfOvs2D
from .lerf_3d import LerfOvs3D
from .method import FieldMethod, Labeller, Method, TeacherMethod, View, best_labels, label_view
from .ovs3d import OVS3DClosed, OVS3DStability, OVS3DThreshold
from .own import KfgsColor, KfgsPooled, KfgsRecolor, KfgsRemoval, KfgsSurface
from .registry import PROTOCOLS, get_protocol
from .relevancy import Encode, lerf_relevancy
from .report import Report, average
from .scannet_points import ScanNetPoints
from .scannet_volume import ScanNetVolume
from .scenesplat import SceneSplatBench
from .segmentation import SegmentationReport, evaluate_segmentation, load_label_map
from .surface import score_surface
from .surface_density import surface_density
from .teacher_agreement import TeacherAgreement
from .truth import LabelTruth, MaskAndBoxes, MaskTruth, PointTruth

__all__ = [
    "PROTOCOLS",
    "Encode",
    "FieldMethod",
    "KfgsColor",
    "KfgsPooled",
    "KfgsRecolor",
    "KfgsRemoval",
    "KfgsSurface",
    "LEGaussiansMasks",
    "LabelSet",
    "LabelTruth",
    "Labeller",
    "LerfOvs2D",
    "LerfOvs3D",
    "MaskAndBoxes",
    "MaskTruth",
    "Method",
    "OVS3DClosed",
    "OVS3DStability",
    "OVS3DThreshold",
    "PointTruth",
    "Report",
    "ScanNetPoints",
    "ScanNetVolume",
    "SceneSplatBench",
    "SegmentationReport",
    "TeacherAgreement",
    "TeacherMethod",
    "View",
    "average",
    "best_labels",
    "evaluate_segmentation",
    "get_protocol",
    "label_view",
    "lerf_relevancy",
    "load_classes",
    "load_label_map",
    "load_label_set",
    "score_recolor",
    "score_removal",
    "score_surface",
    "score_views",
    "surface_density",
]
