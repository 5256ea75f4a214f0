"""Hierarchical compression (Sec. 3.3): the codebook, index maps, the scene's autoencoder, and linear latents."""

from .autoencoder import Autoencoder, AutoencoderConfig, fit_autoencoder
from .codebook import Codebook
from .grow import GrownCodebook, fit_codebook
from .linear import LinearLatents
from .maps import LatentMaps, quantize_maps, sample_grid
from .paper import PaperCodebook

__all__ = [
    "Autoencoder",
    "AutoencoderConfig",
    "Codebook",
    "GrownCodebook",
    "LatentMaps",
    "LinearLatents",
    "PaperCodebook",
    "fit_autoencoder",
    "fit_codebook",
    "quantize_maps",
    "sample_grid",
]
