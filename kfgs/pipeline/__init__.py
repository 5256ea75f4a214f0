"""The whole job (the paper's Figure 2) as a few resumable calls, and the uses of a finished field."""

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
from .attach import attach
from .color import ColorConfig, fit_color
from .compare import views_of_change, write_comparison
from .config import FitConfig
from .describe import describe
from .evaluate import Question, evaluate, open_question
from .fit import fit_scene
from .fuse import uplift
from .label_pictures import segment_cameras, write_coco
from .run_report import write_run_report
from .stages import Run

__all__ = [
    "ColorConfig",
    "FitConfig",
    "Question",
    "Run",
    "attach",
    "describe",
    "evaluate",
    "fit_color",
    "fit_scene",
    "label_cloud",
    "open_question",
    "read_cloud",
    "save_labelled",
    "score_scene",
    "score_teacher",
    "segment_cameras",
    "segment_scene",
    "select_labelled",
    "true_labels",
    "uplift",
    "views_of_change",
    "write_coco",
    "write_comparison",
    "write_report",
    "write_run_report",
    "write_training_pictures",
]
