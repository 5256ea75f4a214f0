"""The whole job (the paper's Figure 2) as a few resumable calls, and the uses of a finished field."""

from ..viz.field_colors import feature_colors
from .apply import (
    label_cloud,
    read_cloud,
    save_labelled,
    score_scene,
    score_teacher,
    segment_scene,
    select_labelled,
    true_labels,
    write_report,
    write_training_pictures,
)
from .attach import Attached, attach
from .color import ColorConfig, ColorResult, fit_color
from .compare import render_color, views_of_change, write_comparison
from .config import FitConfig
from .describe import describe
from .fit import FitResult, fit_scene, load_history
from .fuse import uplift
from .plan import Plan, plan_scene
from .plan_maps import NamedTeacher
from .stages import Run, Stage

__all__ = [
    "Attached",
    "ColorConfig",
    "ColorResult",
    "FitConfig",
    "FitResult",
    "NamedTeacher",
    "Plan",
    "Run",
    "Stage",
    "attach",
    "describe",
    "feature_colors",
    "fit_color",
    "fit_scene",
    "label_cloud",
    "load_history",
    "plan_scene",
    "read_cloud",
    "render_color",
    "save_labelled",
    "score_scene",
    "score_teacher",
    "segment_scene",
    "select_labelled",
    "true_labels",
    "uplift",
    "views_of_change",
    "write_comparison",
    "write_report",
    "write_training_pictures",
]
