"""Labels: classes of codewords, pixels and Gaussians, their transfer to the colour field, and edits (Sec. 3.4)."""

from .classify import Classification, CodewordLabels, classify, label_codewords, select_by_query
from .edit import extract, recolor, remove
from .names import class_index
from .segment import label_pixels, nearest_codeword
from .selection import Selection, select_by_label, select_where
from .threshold import similarity_threshold
from .transfer import Transfer, default_distance, transfer_labels
from .vote import Votes, vote_labels

__all__ = [
    "Classification",
    "CodewordLabels",
    "Selection",
    "Transfer",
    "Votes",
    "class_index",
    "classify",
    "default_distance",
    "extract",
    "label_codewords",
    "label_pixels",
    "nearest_codeword",
    "recolor",
    "remove",
    "select_by_label",
    "select_by_query",
    "select_where",
    "similarity_threshold",
    "transfer_labels",
    "vote_labels",
]
