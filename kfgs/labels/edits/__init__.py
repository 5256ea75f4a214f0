"""Edits as data: small non-destructive operations on a splat file, composable, undoable, saved as JSON and replayed."""

from .edit import Edit, Extract, Opacity, Recolor, Remove
from .edit_list import EditList
from .insert import Insert
from .merge import join
from .motion import Duplicate, Move, Turn

__all__ = ["Duplicate", "Edit", "EditList", "Extract", "Insert", "Move", "Opacity", "Recolor", "Remove", "Turn", "join"]
