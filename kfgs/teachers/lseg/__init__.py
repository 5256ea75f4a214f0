"""LSeg (Li et al., ICLR 2022), the teacher of the paper: dense features in the space of CLIP's text tower."""

from .network import LSegConfig
from .teacher import LSeg, LSegOptions, load_lseg

__all__ = ["LSeg", "LSegConfig", "LSegOptions", "load_lseg"]
