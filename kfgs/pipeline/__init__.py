"""The whole job (the paper's Figure 2) as a few resumable calls, and the uses of a finished field."""

from .attach import attach
from .color import ColorConfig, fit_color
from .evaluate import evaluate, open_question
from .fit import fit
from .methods import Paper, Uplift
from .segment import score_scene, score_teacher, segment_cameras, segment_scene, true_labels

__all__ = [
    "ColorConfig",
    "Paper",
    "Uplift",
    "attach",
    "evaluate",
    "fit",
    "fit_color",
    "open_question",
    "score_scene",
    "score_teacher",
    "segment_cameras",
    "segment_scene",
    "true_labels",
]
