"""Pictures: clouds in pyvista, label overlays, plots and films, all in one palette."""

from .boxes import add_boxes
from .clouds import add_cloud, to_pyvista
from .colors import FeatureColors
from .compare import views_of_change
from .examples import draw_examples
from .films import save_animation, show_cloud
from .frusta import add_cameras
from .legends import add_legend
from .linked import linked_clouds
from .palette import palette
from .pictures import overlay_labels, picture_grid
from .plots import plot_history, plot_iou, plot_scores
from .plotter import draw_view, look_through, make_plotter
from .transfer import show_transfer

__all__ = [
    "FeatureColors",
    "add_boxes",
    "add_cameras",
    "add_cloud",
    "add_legend",
    "draw_examples",
    "draw_view",
    "linked_clouds",
    "look_through",
    "make_plotter",
    "overlay_labels",
    "palette",
    "picture_grid",
    "plot_history",
    "plot_iou",
    "plot_scores",
    "save_animation",
    "show_cloud",
    "show_transfer",
    "to_pyvista",
    "views_of_change",
]
