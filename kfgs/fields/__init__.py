"""The semantic field and two ways to it: features averaged onto Gaussians (*uplift*), or Gaussians trained on maps (Sec. 3.2).

*Fused* are features averaged over the views onto Gaussians, by `uplift_maps` or, of a trained field, by `fuse_views`.
"""

from .decoders import Autoencoded, Codewords, Identity, Linear
from .examples import Box, Clicks, Mask, label_set_from_examples
from .loss import ColorLoss
from .options import Densify, Rates, Training
from .semantic_field import SemanticField
from .start import gaussians_from_points
from .train import fit_field
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
    "uplift_maps",
]
