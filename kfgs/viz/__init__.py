"""Pictures: one palette, label overlays, feature colours, plots, and pyvista clouds with or without a display."""

from .clouds import add_cameras, add_cloud, add_legend, add_transfer
from .headless import available, make_plotter
from .palette import PALETTE, palette
from .pictures import FeatureColors, legend_column, legend_strip, overlay_labels, save_picture
from .plots import plot_codebook_history, plot_confusion, plot_training
from .through import look_through

__all__ = [
    "PALETTE",
    "FeatureColors",
    "add_cameras",
    "add_cloud",
    "add_legend",
    "add_transfer",
    "available",
    "legend_column",
    "legend_strip",
    "look_through",
    "make_plotter",
    "overlay_labels",
    "palette",
    "plot_codebook_history",
    "plot_confusion",
    "plot_training",
    "save_picture",
]
