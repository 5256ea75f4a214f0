"""Labels: classes of pixels and Gaussians, their transfer to the colour field, selections and edits (Sec. 3.4)."""

from .boxes import OrientedBox
from .classify import Classification, classify, label_pixels, nearest_codeword
from .color import parse_color, recolor
from .components import component_numbers
from .edits import Duplicate, Edit, EditList, Extract, Insert, Move, Opacity, Recolor, Remove, join
from .label_set import LabelSet, load_label_set
from .nearest import Transfer, default_distance, nearest_labels
from .parts import Part, connected_parts
from .scores import CANONICAL, LOGIT_SCALE, Score
from .selection import Selection, relevancy, select_by_similarity
from .transfer import transfer_labels
from .where import InBox, InSphere, OfClass, OfIndex, Where

__all__ = [
    "CANONICAL",
    "LOGIT_SCALE",
    "Classification",
    "Duplicate",
    "Edit",
    "EditList",
    "Extract",
    "InBox",
    "InSphere",
    "Insert",
    "LabelSet",
    "Move",
    "OfClass",
    "OfIndex",
    "Opacity",
    "OrientedBox",
    "Part",
    "Recolor",
    "Remove",
    "Score",
    "Selection",
    "Transfer",
    "Where",
    "classify",
    "component_numbers",
    "connected_parts",
    "default_distance",
    "join",
    "label_pixels",
    "load_label_set",
    "nearest_codeword",
    "nearest_labels",
    "parse_color",
    "recolor",
    "relevancy",
    "select_by_similarity",
    "transfer_labels",
]
