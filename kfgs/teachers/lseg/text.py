"""The text tower that LSeg's checkpoint carries: CLIP ViT-B/32's transformer (Radford et al., ICML 2021)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from .network import LSegConfig


class ClipText(nn.Module):
    """Embeddings of tokenised prompts, read off at each prompt's end token.

    Convention: the end token has the largest number of the vocabulary, and what follows its first appearance is ignored
    (attention is causal), so the padding's value does not matter. Embeddings are not normalised.
    """

    def __init__(self, config: LSegConfig) -> None:
        super().__init__()
        width = config.text_width
        self.config = config
        self.token_embedding = nn.Embedding(config.vocabulary, width)
        self.positions = nn.Parameter(torch.zeros(config.context, width))
        self.blocks = nn.Sequential(*(_Block(width, config.text_heads) for _ in range(config.text_layers)))
        self.norm = nn.LayerNorm(width)
        self.projection = nn.Parameter(torch.zeros(width, config.dim))

    def forward(self, ids: Tensor) -> Tensor:  # ids: [n, context] int64 -> [n, D]
        """Embed prompts."""
        tokens = self.blocks(self.token_embedding(ids) + self.positions)  # [n, context, text_width]
        ends = tokens[torch.arange(len(ids), device=ids.device), ids.argmax(dim=1)]
        return self.norm(ends) @ self.projection


class _Block(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm1 = nn.LayerNorm(width)
        self.qkv = nn.Linear(width, 3 * width)
        self.projection = nn.Linear(width, width)
        self.norm2 = nn.LayerNorm(width)
        self.fc1 = nn.Linear(width, 4 * width)
        self.fc2 = nn.Linear(4 * width, width)

    def forward(self, x: Tensor) -> Tensor:  # [n, context, width]
        n, length, width = x.shape
        q, k, v = self.qkv(self.norm1(x)).reshape(n, length, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        out = functional.scaled_dot_product_attention(q, k, v, is_causal=True)
        x = x + self.projection(out.transpose(1, 2).reshape(n, length, width))
        hidden = self.fc1(self.norm2(x))
        return x + self.fc2(hidden * torch.sigmoid(1.702 * hidden))  # CLIP's quick GELU
