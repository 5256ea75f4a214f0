"""More than one machine or more than fits into one: a scene in blocks."""

from .blocks import fit_block, fit_blocks, split_scene
from .in_blocks import FieldInBlocks

__all__ = ["FieldInBlocks", "fit_block", "fit_blocks", "split_scene"]
