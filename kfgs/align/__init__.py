"""The similarity (rotation, translation, scale) between two coordinate frames of one scene; whether two clouds share one."""

from .by_cameras import Alignment, align_by_cameras
from .by_shape import align_clouds
from .frames import FrameCheck, frames_agree

__all__ = ["Alignment", "FrameCheck", "align_by_cameras", "align_clouds", "frames_agree"]
