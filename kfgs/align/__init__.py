"""Alignment: the similarity between two frames of one scene, and whether two clouds share a frame."""

from .by_cameras import Alignment, align_by_cameras
from .by_shape import align_clouds
from .frames import FrameCheck, frames_agree

__all__ = ["Alignment", "FrameCheck", "align_by_cameras", "align_clouds", "frames_agree"]
