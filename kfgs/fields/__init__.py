"""Fields of Gaussians: raw parameters, their training, and the finished semantic field (Sec. 3.2)."""

from .answers import Answers, Seen, fused_answers
from .config import FieldConfig
from .densify import Densified, GradientStatistics, densify
from .examples import Box, Clicks, Mask, Picked, label_set_from_examples, read_examples
from .fit import FieldFit, fit_field
from .loss import ColorLoss, Loss, l1_loss
from .merge import Merged, merge_gaussians
from .optimizer import FieldOptimizer
from .packed import pack_field, unpack_field
from .params import GaussianParams
from .remembered import recall_scene, remember
from .semantic_field import Rule, SemanticField
from .uplift import UpliftConfig, Uplifted, uplift_maps

__all__ = [
    "Answers",
    "Box",
    "Clicks",
    "ColorLoss",
    "Densified",
    "FieldConfig",
    "FieldFit",
    "FieldOptimizer",
    "GaussianParams",
    "GradientStatistics",
    "Loss",
    "Mask",
    "Merged",
    "Picked",
    "Rule",
    "Seen",
    "SemanticField",
    "UpliftConfig",
    "Uplifted",
    "densify",
    "fit_field",
    "fused_answers",
    "l1_loss",
    "label_set_from_examples",
    "merge_gaussians",
    "pack_field",
    "read_examples",
    "recall_scene",
    "remember",
    "unpack_field",
    "uplift_maps",
]
