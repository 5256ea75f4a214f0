"""Hierarchical compression (Sec. 3.3): the adaptive codebook, index maps, and the scene's autoencoder."""

from .autoencoder import Autoencoder
from .clusters import spherical_kmeans
from .codebook import Codebook, Nearest
from .evolve import expand, prune
from .fit_autoencoder import AutoencoderConfig, fit_autoencoder
from .fit_codebook import CodebookConfig, CodebookFit, fit_codebook
from .linear import LinearLatents, fit_linear_latents
from .maps import FeatureMaps, IndexMaps, LatentMaps, quantize_maps
from .sampling import choose_grid_step, grid_slices, sample_grid

__all__ = [
    "Autoencoder",
    "AutoencoderConfig",
    "Codebook",
    "CodebookConfig",
    "CodebookFit",
    "FeatureMaps",
    "IndexMaps",
    "LatentMaps",
    "LinearLatents",
    "Nearest",
    "choose_grid_step",
    "expand",
    "fit_autoencoder",
    "fit_codebook",
    "fit_linear_latents",
    "grid_slices",
    "prune",
    "quantize_maps",
    "sample_grid",
    "spherical_kmeans",
]
