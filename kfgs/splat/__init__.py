"""Gaussian splatting: project, bin, composite."""

from .covariance import covariance_3d
from .engines import (
    ALPHA_MAX,
    ALPHA_MIN,
    TRANSMITTANCE_MIN,
    accumulate_pixels,
    available_engines,
    composite,
    free_memory,
    rank_channels,
)
from .engines.contract import Ranked
from .project import Projected, project
from .rasterize import Rendering, rasterize, rasterize_labels
from .sh import SH_C0, evaluate_sh, rgb_to_sh0, rotate_sh, sh0_to_rgb
from .tiles import Tiles, bin_tiles
from .transform import transform_gaussians
from .views import average_views, sum_pixels, vote_labels

__all__ = [
    "ALPHA_MAX",
    "ALPHA_MIN",
    "SH_C0",
    "TRANSMITTANCE_MIN",
    "Projected",
    "Ranked",
    "Rendering",
    "Tiles",
    "accumulate_pixels",
    "available_engines",
    "average_views",
    "bin_tiles",
    "composite",
    "covariance_3d",
    "evaluate_sh",
    "free_memory",
    "project",
    "rank_channels",
    "rasterize",
    "rasterize_labels",
    "rgb_to_sh0",
    "rotate_sh",
    "sh0_to_rgb",
    "sum_pixels",
    "transform_gaussians",
    "vote_labels",
]
