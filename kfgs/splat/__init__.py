"""Gaussian splatting: project, bin, composite."""

from .engines import (
    ALPHA_MIN,
    accumulate_pixels,
    available_engines,
    composite,
    free_memory,
)
from .project import Projected, project
from .rasterize import Rendering, rasterize, rasterize_labels
from .tiles import Tiles, bin_tiles
from .transform import transform_gaussians
from .views import average_views, vote_labels

__all__ = [
    "ALPHA_MIN",
    "Projected",
    "Rendering",
    "Tiles",
    "accumulate_pixels",
    "available_engines",
    "average_views",
    "bin_tiles",
    "composite",
    "free_memory",
    "project",
    "rasterize",
    "rasterize_labels",
    "transform_gaussians",
    "vote_labels",
]
