"""Decoupled semantic fields of 3-D Gaussians: distil, compress, segment, label, edit.

Names are imported when first used, so that `import kfgs` is quick and works on a headless machine.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

_WHERE = {
    "Gaussians": ".gaussians",
    "Camera": ".cameras",
    "Distortion": ".cameras",
    "resize_map": ".cameras",
    "Rendering": ".splat",
    "rasterize": ".splat",
    "available_engines": ".splat",
    "Autoencoder": ".quant",
    "AutoencoderConfig": ".quant",
    "Codebook": ".quant",
    "GrownCodebook": ".quant",
    "PaperCodebook": ".quant",
    "fit_autoencoder": ".quant",
    "fit_codebook": ".quant",
    "quantize_maps": ".quant",
    "Scene": ".scenes",
    "SceneError": ".scenes",
    "load_scene": ".scenes",
    "run_sfm": ".scenes",
    "ToyConfig": ".toy",
    "make_toy_room": ".toy",
    "Similarity": ".cameras",
    "read_splats": ".formats",
    "write_splats": ".formats",
    "EditList": ".labels",
    "Recolor": ".labels",
    "Remove": ".labels",
    "Selection": ".labels",
    "OfClass": ".labels",
    "connected_parts": ".labels",
    "transform_gaussians": ".splat",
    "ColorConfig": ".pipeline",
    "attach": ".pipeline",
    "fit_color": ".pipeline",
    "score_views": ".evaluation",
    "transfer_labels": ".labels",
    "FeatureFolder": ".scenes",
    "load_teacher": ".teachers",
    "extract_features": ".scenes",
    "make_label_set": ".teachers",
    "Teacher": ".teachers",
    "Uplift": ".pipeline",
    "Paper": ".pipeline",
    "UpliftConfig": ".fields",
    "Training": ".fields",
    "GaussianParams": ".fields",
    "SemanticField": ".fields",
    "fit_field": ".fields",
    "fit": ".pipeline",
    "segment_scene": ".pipeline",
    "score_scene": ".pipeline",
    "LabelSet": ".labels",
    "label_set_from_examples": ".fields",
    "evaluate_segmentation": ".evaluation",
    "load_label_set": ".labels",
    "explore": ".viewer",
}
__version__ = "0.1.0"
__all__ = sorted(_WHERE)

if TYPE_CHECKING:
    from .cameras import Camera as Camera
    from .cameras import Distortion as Distortion
    from .cameras import Similarity as Similarity
    from .cameras import resize_map as resize_map
    from .evaluation import evaluate_segmentation as evaluate_segmentation
    from .evaluation import score_views as score_views
    from .fields import GaussianParams as GaussianParams
    from .fields import SemanticField as SemanticField
    from .fields import Training as Training
    from .fields import UpliftConfig as UpliftConfig
    from .fields import fit_field as fit_field
    from .fields import label_set_from_examples as label_set_from_examples
    from .formats import read_splats as read_splats
    from .formats import write_splats as write_splats
    from .gaussians import Gaussians as Gaussians
    from .labels import EditList as EditList
    from .labels import LabelSet as LabelSet
    from .labels import OfClass as OfClass
    from .labels import Recolor as Recolor
    from .labels import Remove as Remove
    from .labels import Selection as Selection
    from .labels import connected_parts as connected_parts
    from .labels import load_label_set as load_label_set
    from .labels import transfer_labels as transfer_labels
    from .pipeline import ColorConfig as ColorConfig
    from .pipeline import Paper as Paper
    from .pipeline import Uplift as Uplift
    from .pipeline import attach as attach
    from .pipeline import fit as fit
    from .pipeline import fit_color as fit_color
    from .pipeline import score_scene as score_scene
    from .pipeline import segment_scene as segment_scene
    from .quant import Autoencoder as Autoencoder
    from .quant import AutoencoderConfig as AutoencoderConfig
    from .quant import Codebook as Codebook
    from .quant import GrownCodebook as GrownCodebook
    from .quant import PaperCodebook as PaperCodebook
    from .quant import fit_autoencoder as fit_autoencoder
    from .quant import fit_codebook as fit_codebook
    from .quant import quantize_maps as quantize_maps
    from .scenes import FeatureFolder as FeatureFolder
    from .scenes import Scene as Scene
    from .scenes import SceneError as SceneError
    from .scenes import extract_features as extract_features
    from .scenes import load_scene as load_scene
    from .scenes import run_sfm as run_sfm
    from .splat import Rendering as Rendering
    from .splat import available_engines as available_engines
    from .splat import rasterize as rasterize
    from .splat import transform_gaussians as transform_gaussians
    from .teachers import Teacher as Teacher
    from .teachers import load_teacher as load_teacher
    from .teachers import make_label_set as make_label_set
    from .toy import ToyConfig as ToyConfig
    from .toy import make_toy_room as make_toy_room
    from .viewer import explore as explore


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module 'kfgs' has no attribute {name!r}; public names: {', '.join(__all__)}")
    return getattr(import_module(_WHERE[name], __name__), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


def _one_thread_after_a_fork() -> None:
    """Keep torch to one thread in a forked child: the others of its parent are not there, and it would wait for them."""
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_one_thread_after_a_fork)
