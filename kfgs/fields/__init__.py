"""Fields of Gaussians: raw parameters, their training, and the finished semantic field (Sec. 3.2)."""

from .decoders import Autoencoded, Codewords, Decoder, Identity, Linear
from .examples import Box, Clicks, Mask, Picked, label_set_from_examples, read_examples
from .fused import fuse_views, join_fields
from .loss import ColorLoss, Loss, l1_loss
from .merge import merge_gaussians
from .notes import recall_scene, scene_classes
from .packing import Rounding
from .params import GaussianParams
from .semantic_field import Seen, SemanticField
from .train import FieldFit, fit_field
from .training import Densify, Rates, Training
from .uplift import UpliftConfig, sample_latents, uplift_maps

__all__ = [
    "Autoencoded",
    "Box",
    "Clicks",
    "Codewords",
    "ColorLoss",
    "Decoder",
    "Densify",
    "FieldFit",
    "GaussianParams",
    "Identity",
    "Linear",
    "Loss",
    "Mask",
    "Picked",
    "Rates",
    "Rounding",
    "Seen",
    "SemanticField",
    "Training",
    "UpliftConfig",
    "fit_field",
    "fuse_views",
    "join_fields",
    "l1_loss",
    "label_set_from_examples",
    "merge_gaussians",
    "read_examples",
    "recall_scene",
    "sample_latents",
    "scene_classes",
    "uplift_maps",
]
