"""Fields of Gaussians: raw parameters, their training, and the finished semantic field (Sec. 3.2)."""

from .decoders import Autoencoded, Codewords, Identity, Linear
from .examples import Box, Clicks, Mask, label_set_from_examples
from .loss import ColorLoss
from .merge import merge_gaussians
from .semantic_field import SemanticField
from .start import gaussians_from_points
from .train import fit_field
from .training import Densify, Rates, Training
from .uplift import UpliftConfig, fuse_views, uplift_maps

__all__ = [
    "Autoencoded",
    "Box",
    "Clicks",
    "Codewords",
    "ColorLoss",
    "Densify",
    "Identity",
    "Linear",
    "Mask",
    "Rates",
    "SemanticField",
    "Training",
    "UpliftConfig",
    "fit_field",
    "fuse_views",
    "gaussians_from_points",
    "label_set_from_examples",
    "merge_gaussians",
    "uplift_maps",
]
