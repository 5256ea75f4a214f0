"""Labels: classes of pixels and Gaussians, their transfer to the colour field, selections and edits (Sec. 3.4)."""

from .classify import classify
from .edit_list import EditList, Insert
from .edits import Duplicate, Extract, Move, Opacity, Recolor, Remove
from .instances import number_instances
from .label_set import LabelSet, load_label_set
from .parts import OrientedBox, Part, connected_parts
from .selection import InBox, OfClass, Selection
from .transfer import Transfer, nearest_labels, transfer_labels

__all__ = [
    "Duplicate",
    "EditList",
    "Extract",
    "InBox",
    "Insert",
    "LabelSet",
    "Move",
    "OfClass",
    "Opacity",
    "OrientedBox",
    "Part",
    "Recolor",
    "Remove",
    "Selection",
    "Transfer",
    "classify",
    "connected_parts",
    "load_label_set",
    "nearest_labels",
    "number_instances",
    "transfer_labels",
]
