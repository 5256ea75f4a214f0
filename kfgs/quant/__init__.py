"""Hierarchical compression (Sec. 3.3): the adaptive codebook, index maps, and the scene's autoencoder."""

from .autoencoder import Autoencoder
from .clusters import Clusters, spherical_kmeans
from .codebook import Codebook, Nearest
from .evolve import expand, prune
from .fit_autoencoder import AutoencoderConfig, AutoencoderFit, fit_autoencoder
from .fit_codebook import CodebookConfig, CodebookFit, fit_codebook
from .linear import LinearLatents, fit_linear_latents
from .loss import BalancedLoss, class_balanced_loss
from .maps import FeatureMaps, IndexMaps, LatentMaps, quantize_maps
from .sampling import choose_grid_step, farthest_points, grid_slices, sample_grid

__all__ = [
    "Autoencoder",
    "AutoencoderConfig",
    "AutoencoderFit",
    "BalancedLoss",
    "Clusters",
    "Codebook",
    "CodebookConfig",
    "CodebookFit",
    "FeatureMaps",
    "IndexMaps",
    "LatentMaps",
    "LinearLatents",
    "Nearest",
    "choose_grid_step",
    "class_balanced_loss",
    "expand",
    "farthest_points",
    "fit_autoencoder",
    "fit_codebook",
    "fit_linear_latents",
    "grid_slices",
    "prune",
    "quantize_maps",
    "sample_grid",
    "spherical_kmeans",
]
