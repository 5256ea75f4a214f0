"""The image network of LSeg (Li et al., ICLR 2022): a ViT-L/16 whose tokens a DPT decoder (Ranftl et al., ICCV 2021) fuses.

The ViT is kornia's. The checkpoint's own names are translated in `keys`; the text tower is in `text`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from kornia.models.vit import MultiHeadAttention, VisionTransformer
from torch import Tensor, nn
from torch.nn import functional

from ..._check import check_shapes, check_whole

_PATCH = 16  # the decoder enlarges the grid of tokens 8 times, which is half of 16


@dataclass(frozen=True)
class LSegConfig:
    """Sizes of the network and of its text tower. The defaults are `demo_e200.ckpt`, backbone clip_vitl16_384.

    Raises:
        ValueError: if sizes contradict each other.
    """

    width: int = 1024  # channels of a token
    depth: int = 24  # blocks of the ViT
    heads: int = 16
    patch: int = 16  # pixels; the decoder works with no other
    position_grid: int = 24  # the checkpoint's position embeddings lie on a square of so many (384 pixels)
    window: int = 480  # pixels; side S of the only picture the network takes
    hooks: tuple[int, ...] = (5, 11, 17, 23)  # blocks whose outputs are decoded, from 0
    neck: tuple[int, ...] = (256, 512, 1024, 1024)  # channels each hook is brought to, fine to coarse
    fusion: int = 256  # channels within the decoder
    dim: int = 512  # D: channels of the features, and of a text's embedding
    text_width: int = 512
    text_layers: int = 12
    text_heads: int = 8
    context: int = 77  # tokens of a prompt
    vocabulary: int = 49408

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            for each in value if name == "neck" else () if name == "hooks" else (value,):
                check_whole(name, each, 1)
        if self.patch != _PATCH:
            raise ValueError(
                f"patch: expected {_PATCH}, got {self.patch}; the decoder is made for patches of that size"
            )
        if self.window % (2 * _PATCH):
            raise ValueError(f"window: expected a multiple of {2 * _PATCH} pixels, got {self.window}; round it")
        if len(self.hooks) != 4 or not all(
            a < b for a, b in zip((-1, *self.hooks), (*self.hooks, self.depth), strict=True)
        ):
            raise ValueError(
                f"hooks: expected four rising block numbers below depth = {self.depth}, got {self.hooks}; count from 0"
            )
        if len(self.neck) != 4:
            raise ValueError(f"neck: expected four channel counts, one per hook, got {self.neck}; pass four")
        for width, heads in (("width", "heads"), ("text_width", "text_heads")):
            if getattr(self, width) % getattr(self, heads):
                raise ValueError(
                    f"{heads}: expected a divisor of {width} = {getattr(self, width)}, got {getattr(self, heads)}; "
                    "heads share the channels evenly"
                )

    @property
    def grid(self) -> int:
        """Tokens along a side of the window."""
        return self.window // self.patch

    @property
    def mlp(self) -> int:
        """Hidden channels of a ViT block's MLP, fixed by kornia's ViT."""
        return 4 * self.width

    @property
    def text_mlp(self) -> int:
        """Hidden channels of a text block's MLP."""
        return 4 * self.text_width
