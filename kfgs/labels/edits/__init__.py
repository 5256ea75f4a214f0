"""Edits as data: small non-destructive operations on a splat file, composable, undoable, saved as JSON and replayed."""

from .appearance import Opacity, Recolor
from .base import Edit
from .edit_list import EditList
from .insert import Insert
from .merge import join
from .motion import Duplicate, Move, Turn
from .presence import Extract, Remove

__all__ = ["Duplicate", "Edit", "EditList", "Extract", "Insert", "Move", "Opacity", "Recolor", "Remove", "Turn", "join"]
