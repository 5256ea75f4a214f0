"""The toy room: a small scene that the package makes itself, with exact truth and a noisy teacher."""

from .room import build_room
from .room_folder import ToyConfig, make_toy_room

__all__ = ["ToyConfig", "build_room", "make_toy_room"]
