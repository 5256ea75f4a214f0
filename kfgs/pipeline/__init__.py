"""The whole job (the paper's Figure 2) as a few resumable calls, and the uses of a finished field."""

from .attach import attach
from .color import ColorConfig, fit_color
from .compare import views_of_change, write_comparison
from .describe import describe
from .evaluate import Question, evaluate, open_question
from .fit import fit
from .label import label_cloud, save_labelled
from .methods import Paper, Uplift
from .run_report import write_run_report
from .segment import score_scene, score_teacher, segment_cameras, segment_scene, true_labels, write_coco
from .stages import Run

__all__ = [
    "ColorConfig",
    "Paper",
    "Question",
    "Run",
    "Uplift",
    "attach",
    "describe",
    "evaluate",
    "fit",
    "fit_color",
    "label_cloud",
    "open_question",
    "save_labelled",
    "score_scene",
    "score_teacher",
    "segment_cameras",
    "segment_scene",
    "true_labels",
    "views_of_change",
    "write_coco",
    "write_comparison",
    "write_run_report",
]
