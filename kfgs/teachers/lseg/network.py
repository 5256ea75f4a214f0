"""The image network of LSeg (Li et al., ICLR 2022): a ViT-L/16 whose tokens a DPT decoder (Ranftl et al., ICCV 2021) fuses.

The ViT is kornia's. The checkpoint's own names are translated in `keys`; the text tower is that of transformers.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from kornia.models.vit import MultiHeadAttention, VisionTransformer
from torch import Tensor, nn
from torch.nn import functional

from ..._check import check_shapes

_PATCH = 16  # the decoder enlarges the grid of tokens 8 times, which is half of 16


@dataclass(frozen=True)
class LSegConfig:
    """Sizes of the network and of its text tower. The defaults are `demo_e200.ckpt`, backbone clip_vitl16_384."""

    width: int = 1024  # channels of a token
    depth: int = 24  # blocks of the ViT
    heads: int = 16
    position_grid: int = 24  # side of the checkpoint's square of position embeddings (384 pixels)
    window: int = 480  # pixels; side S of the network's input
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
        assert self.window % (2 * _PATCH) == 0, "windows are cut into patches, whose grid is halved once"
        assert len(self.hooks) == len(self.neck) == 4
        assert list(self.hooks) == sorted(self.hooks) and self.hooks[-1] < self.depth  # noqa: PT018
        assert self.width % self.heads == 0

    @property
    def grid(self) -> int:
        """Tokens along a side of the window."""
        return self.window // _PATCH


class LSegNetwork(nn.Module):
    """Features of a window at half its resolution: LSeg up to `head1`, before the last enlargement, which is linear.

    Convention: x is in [-1, 1], channels RGB; the position embeddings have the window's grid. Nothing is normalised.
    Training it is not intended: `keys.network_from_state` builds it for evaluation, from a checkpoint.
    """

    def __init__(self, config: LSegConfig) -> None:
        super().__init__()
        self.config = config
        self.vit = VisionTransformer(config.window, _PATCH, 3, config.width, config.depth, config.heads)
        self.vit.norm = nn.Identity()  # LSeg decodes the outputs of blocks; the last norm is unused
        for block in self.vit.encoder.blocks:
            block[0].fn[1] = _Attention(config.width, config.heads, 0.0, 0.0)
        self.reassemble = nn.ModuleList(_Reassemble(config, level) for level in range(4))
        self.fusion = nn.ModuleList(_Fusion(config.fusion, skip=level < 3) for level in range(4))
        self.head = nn.Conv2d(config.fusion, config.dim, 1)

    def forward(self, x: Tensor) -> Tensor:  # x: [B, 3, S, S] -> [B, D, S / 2, S / 2]
        """Encode windows. Raises a ValueError if a window is not S x S."""
        check_shapes(("x", x, ("B", 3, self.config.window, self.config.window)))
        # Block by block: the ViT's own forward would keep the outputs of all blocks, 88 MB a window, until the next call.
        tokens = self.vit.patch_embedding(x)  # [B, 1 + grid * grid, width]
        hooked = []
        for index, block in enumerate(self.vit.encoder.blocks[: self.config.hooks[-1] + 1]):
            tokens = block(tokens)
            if index in self.config.hooks:
                hooked.append(tokens)
        levels = [part(each) for part, each in zip(self.reassemble, hooked, strict=True)]  # fine to coarse
        path = self.fusion[3](levels[3], None)
        for level in (2, 1, 0):
            path = self.fusion[level](path, levels[level])
        return self.head(path)


class _Attention(MultiHeadAttention):
    """kornia's attention with torch's fused kernel instead of its einsum: the same sum without the N x N matrix."""

    def forward(self, x: Tensor) -> Tensor:  # [B, N, width]
        B, N, width = x.shape
        q, k, v = (
            self.qkv(x).reshape(B, N, 3, self.num_heads, -1).permute(2, 0, 3, 1, 4)
        )  # [B, heads, N, width / heads]
        out = functional.scaled_dot_product_attention(q, k, v)
        return self.projection(out.transpose(1, 2).reshape(B, N, width))


class _Reassemble(nn.Module):
    """Tokens of one hook as a map of its level: the readout is projected into each patch, then the grid is resized."""

    def __init__(self, config: LSegConfig, level: int) -> None:
        super().__init__()
        width, channels = config.width, config.neck[level]
        self.grid = config.grid
        self.project = nn.Linear(2 * width, width)
        self.expand = nn.Conv2d(width, channels, 1)
        self.resize = (  # 4, 2, 1 and 1/2 times the grid
            nn.ConvTranspose2d(channels, channels, 4, stride=4),
            nn.ConvTranspose2d(channels, channels, 2, stride=2),
            nn.Identity(),
            nn.Conv2d(channels, channels, 3, stride=2, padding=1),
        )[level]
        self.narrow = nn.Conv2d(channels, config.fusion, 3, padding=1, bias=False)

    def forward(self, tokens: Tensor) -> Tensor:  # [B, 1 + grid * grid, width] -> [B, fusion, h, w]
        readout, patches = tokens[:, :1], tokens[:, 1:]
        patches = functional.gelu(self.project(torch.cat([patches, readout.expand_as(patches)], dim=2)))
        grid = patches.transpose(1, 2).unflatten(2, (self.grid, self.grid))
        return self.narrow(self.resize(self.expand(grid)))


class _ResidualUnit(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(channels)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(channels)

    def forward(self, x: Tensor) -> Tensor:
        inner = self.bn1(self.conv1(functional.relu(x)))
        return x + self.bn2(self.conv2(functional.relu(inner)))


class _Fusion(nn.Module):
    """The path from the coarser levels and, at all but the coarsest, its own level's map, enlarged twice."""

    def __init__(self, channels: int, *, skip: bool) -> None:
        super().__init__()
        self.unit1 = _ResidualUnit(channels) if skip else None
        self.unit2 = _ResidualUnit(channels)
        self.out = nn.Conv2d(channels, channels, 1)

    def forward(self, path: Tensor, own: Tensor | None) -> Tensor:  # [B, C, h, w] -> [B, C, 2 h, 2 w]
        if self.unit1 is not None:
            path = path + self.unit1(own)
        path = self.unit2(path)
        return self.out(functional.interpolate(path, scale_factor=2, mode="bilinear", align_corners=True))
