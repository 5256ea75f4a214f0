"""Cameras: where a view stands, how it projects, how its maps are resampled. All mathematics through kornia."""

from .camera import Camera, Distortion

__all__ = ["Camera", "Distortion"]
