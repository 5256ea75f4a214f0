"""Labels: classes of codewords, pixels and Gaussians, their transfer to the colour field, and edits (Sec. 3.4)."""

from .._names import class_index, class_indices
from .boxes import OrientedBox
from .classify import (
    Classification,
    CodewordLabels,
    classify,
    label_codewords,
    select_by_category,
    select_by_query,
    select_like,
    select_near,
)
from .color import parse_color, recolor
from .components import component_numbers
from .edits import Duplicate, Edit, EditList, Extract, Insert, Move, Opacity, Recolor, Remove, join
from .label_set import LabelSet, load_label_set
from .nearest import Transfer, default_distance, nearest_labels
from .parts import Part, connected_parts, describe_selection
from .scores import CANONICAL, LOGIT_SCALES, Score, relevancy, select_by_similarity
from .segment import label_pixels, nearest_codeword
from .selection import Selection
from .transfer import transfer_labels
from .views import average_views, vote_labels
from .where import InBox, InSphere, OfClass, OfIndex, Where

__all__ = [
    "CANONICAL",
    "LOGIT_SCALES",
    "Classification",
    "CodewordLabels",
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
    "average_views",
    "class_index",
    "class_indices",
    "classify",
    "component_numbers",
    "connected_parts",
    "default_distance",
    "describe_selection",
    "join",
    "label_codewords",
    "label_pixels",
    "load_label_set",
    "nearest_codeword",
    "nearest_labels",
    "parse_color",
    "recolor",
    "relevancy",
    "select_by_category",
    "select_by_query",
    "select_by_similarity",
    "select_like",
    "select_near",
    "transfer_labels",
    "vote_labels",
]
