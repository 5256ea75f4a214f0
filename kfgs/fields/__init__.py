"""Fields of Gaussians: raw parameters, their training, and the finished semantic field (Sec. 3.2)."""

from .answers import Answers, Seen, fused_answers
from .config import FieldConfig
from .examples import Box, Clicks, Mask, Picked, label_set_from_examples, read_examples
from .fit import FieldFit, fit_field
from .joined import join_fields, select_gaussians
from .loss import ColorLoss, Loss, l1_loss
from .merge import merge_gaussians
from .packed import pack_field, unpack_field
from .params import GaussianParams
from .precision import Rounding
from .remembered import recall_scene, remember
from .semantic_field import Rule, SemanticField
from .uplift import UpliftConfig, sample_latents, uplift_maps
from .views import score_pixels

__all__ = [
    "Answers",
    "Box",
    "Clicks",
    "ColorLoss",
    "FieldConfig",
    "FieldFit",
    "GaussianParams",
    "Loss",
    "Mask",
    "Picked",
    "Rounding",
    "Rule",
    "Seen",
    "SemanticField",
    "UpliftConfig",
    "fit_field",
    "fused_answers",
    "join_fields",
    "l1_loss",
    "label_set_from_examples",
    "merge_gaussians",
    "pack_field",
    "read_examples",
    "recall_scene",
    "remember",
    "sample_latents",
    "score_pixels",
    "select_gaussians",
    "unpack_field",
    "uplift_maps",
]
