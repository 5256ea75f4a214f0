"""Hierarchical compression (Sec. 3.3): the codebook, index maps, the scene's autoencoder, and linear latents."""

from .autoencoder import Autoencoder
from .codebook import Codebook
from .fit_autoencoder import AutoencoderConfig, fit_autoencoder
from .fit_codebook import fit_codebook
from .grow import GrownCodebook
from .kmeans import spherical_kmeans
from .linear import LinearLatents, fit_linear_latents
from .maps import IndexMaps, LatentMaps, quantize_maps
from .paper import PaperCodebook
from .sampling import FeatureMaps, sample_grid

__all__ = [
    "Autoencoder",
    "AutoencoderConfig",
    "Codebook",
    "FeatureMaps",
    "GrownCodebook",
    "IndexMaps",
    "LatentMaps",
    "LinearLatents",
    "PaperCodebook",
    "fit_autoencoder",
    "fit_codebook",
    "fit_linear_latents",
    "quantize_maps",
    "sample_grid",
    "spherical_kmeans",
]
