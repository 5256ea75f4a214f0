"""Fields of Gaussians: raw parameters, their training, and the finished semantic field (Sec. 3.2)."""

from .config import FieldConfig
from .densify import Densified, GradientStatistics, densify
from .fit import FieldFit, fit_field
from .loss import ColorLoss, Loss, l1_loss
from .optimizer import FieldOptimizer
from .params import GaussianParams
from .semantic_field import SemanticField

__all__ = [
    "ColorLoss",
    "Densified",
    "FieldConfig",
    "FieldFit",
    "FieldOptimizer",
    "GaussianParams",
    "GradientStatistics",
    "Loss",
    "SemanticField",
    "densify",
    "fit_field",
    "l1_loss",
]
