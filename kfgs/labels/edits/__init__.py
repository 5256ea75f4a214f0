"""Edits as data: small non-destructive operations on a cloud, composable, undoable, saved as JSON and replayed."""

from .edit import Edit, Extract, Opacity, Recolor, Remove
from .edit_list import EditList
from .insert import Insert, join
from .motion import Duplicate, Move

__all__ = ["Duplicate", "Edit", "EditList", "Extract", "Insert", "Move", "Opacity", "Recolor", "Remove", "join"]
