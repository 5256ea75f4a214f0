"""LSeg (Li et al., ICLR 2022), the teacher of the paper: dense features in the space of CLIP's text tower."""

from .network import LSegConfig

__all__ = ["LSegConfig"]
