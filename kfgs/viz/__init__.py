"""Pictures: label overlays, plots, 3-D clouds (pyvista), films and the explorer, all in one palette."""

from .animation import save_animation
from .boxes import add_boxes, add_names, add_selections
from .bridges import to_open3d, to_trimesh
from .camera_view import draw_view, look_through
from .clouds import CloudOptions, add_cloud, recolor_cloud, to_pyvista
from .confusions import plot_confusion, plot_largest_confusions
from .examples import draw_examples
from .field_colors import FeatureColors, feature_colors
from .film_frames import show_cloud
from .films import save_flythrough, save_turntable
from .frusta import add_camera_images, add_cameras
from .headless import available, make_plotter
from .histograms import plot_distances, plot_scores
from .legends import add_legend, add_scalar_bar
from .linked import linked_clouds
from .matches import Matches, add_matches, add_transfer, match_states
from .palette import palette
from .pictures import legend_strip, overlay_labels, picture_grid, save_picture
from .plots import (
    plot_codebook_history,
    plot_iou,
    plot_quality_storage,
    plot_training,
)
from .reports import plot_codebook_growth, plot_codebook_report
from .usd import save_usd

__all__ = [
    "CloudOptions",
    "FeatureColors",
    "Matches",
    "add_boxes",
    "add_camera_images",
    "add_cameras",
    "add_cloud",
    "add_legend",
    "add_matches",
    "add_names",
    "add_scalar_bar",
    "add_selections",
    "add_transfer",
    "available",
    "draw_examples",
    "draw_view",
    "feature_colors",
    "legend_strip",
    "linked_clouds",
    "look_through",
    "make_plotter",
    "match_states",
    "overlay_labels",
    "palette",
    "picture_grid",
    "plot_codebook_growth",
    "plot_codebook_history",
    "plot_codebook_report",
    "plot_confusion",
    "plot_distances",
    "plot_iou",
    "plot_largest_confusions",
    "plot_quality_storage",
    "plot_scores",
    "plot_training",
    "recolor_cloud",
    "save_animation",
    "save_flythrough",
    "save_picture",
    "save_turntable",
    "save_usd",
    "show_cloud",
    "to_open3d",
    "to_pyvista",
    "to_trimesh",
]
