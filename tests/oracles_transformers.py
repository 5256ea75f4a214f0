"""Teachers' dense features, written dully from their equations in float64."""

import math

import numpy as np
import torch
from torch import nn


def layer_norm(x, weight, bias, eps):
    mean = x.mean(axis=-1, keepdims=True)
    variance = ((x - mean) ** 2).mean(axis=-1, keepdims=True)
    return (x - mean) / np.sqrt(variance + eps) * weight + bias


def clip_values(hidden, state, layer, eps):
    """CLIP's last block by MaskCLIP: hidden [T, C] goes in; LN, values, output projection, final LN, projection [T, D]."""
    w = {name: tensor.double().numpy() for name, tensor in state.items()}
    block = f"vision_model.encoder.layers.{layer}."
    x = layer_norm(hidden, w[block + "layer_norm1.weight"], w[block + "layer_norm1.bias"], eps)
    v = x @ w[block + "self_attn.v_proj.weight"].T + w[block + "self_attn.v_proj.bias"]
    v = v @ w[block + "self_attn.out_proj.weight"].T + w[block + "self_attn.out_proj.bias"]
    return v, w, block


def clip_features(hidden, state, layer, eps):
    v, w, _ = clip_values(hidden, state, layer, eps)
    v = layer_norm(v, w["vision_model.post_layernorm.weight"], w["vision_model.post_layernorm.bias"], eps)
    return v[1:] @ w["visual_projection.weight"].T  # the first token is the class token


def siglip_features(hidden, state, eps):
    """SigLIP's pooling head with all attention on one token, for each token: hidden [T, C], after the final norm."""
    w = {name: tensor.double().numpy() for name, tensor in state.items()}
    head = "vision_model.head."
    C = hidden.shape[1]
    weight, bias = w[head + "attention.in_proj_weight"], w[head + "attention.in_proj_bias"]
    v = hidden @ weight[2 * C : 3 * C].T + bias[2 * C : 3 * C]
    v = v @ w[head + "attention.out_proj.weight"].T + w[head + "attention.out_proj.bias"]
    y = layer_norm(v, w[head + "layernorm.weight"], w[head + "layernorm.bias"], eps)
    y = y @ w[head + "mlp.fc1.weight"].T + w[head + "mlp.fc1.bias"]
    y = 0.5 * y * (1 + np.tanh(math.sqrt(2 / math.pi) * (y + 0.044715 * y**3)))  # GELU by tanh
    return v + y @ w[head + "mlp.fc2.weight"].T + w[head + "mlp.fc2.bias"]


class OpenClip(nn.Module):
    """A small CLIP with OpenCLIP's names of weights: two transformers of torch's own attention, exact GELU."""

    def __init__(self, *, width, heads, layers, patch, cells, text_width, text_heads, length, vocabulary, dim):
        super().__init__()
        self.visual = nn.Module()
        self.visual.conv1 = nn.Conv2d(3, width, patch, patch, bias=False)
        self.visual.class_embedding = nn.Parameter(torch.randn(width))
        self.visual.positional_embedding = nn.Parameter(torch.randn(cells * cells + 1, width))
        self.visual.ln_pre, self.visual.ln_post = nn.LayerNorm(width), nn.LayerNorm(width)
        self.visual.transformer = _transformer(width, heads, layers)
        self.visual.proj = nn.Parameter(torch.randn(width, dim))
        self.transformer = _transformer(text_width, text_heads, layers)
        self.token_embedding = nn.Embedding(vocabulary, text_width)
        self.positional_embedding = nn.Parameter(torch.randn(length, text_width))
        self.ln_final = nn.LayerNorm(text_width)
        self.text_projection = nn.Parameter(torch.randn(text_width, dim))
        self.logit_scale = nn.Parameter(torch.tensor(2.5))
        self.register_buffer("attn_mask", torch.full((length, length), -math.inf).triu(1))

    def image(self, pixels):
        x = self.visual.conv1(pixels).flatten(2).transpose(1, 2)
        x = torch.cat([self.visual.class_embedding.expand(len(x), 1, -1), x], dim=1) + self.visual.positional_embedding
        x = _run(self.visual.transformer, self.visual.ln_pre(x), None)
        return self.visual.ln_post(x[:, 0]) @ self.visual.proj

    def text(self, ids):
        T = ids.shape[1]
        x = self.token_embedding(ids) + self.positional_embedding[:T]
        x = self.ln_final(_run(self.transformer, x, self.attn_mask[:T, :T]))
        return x[torch.arange(len(ids)), ids.argmax(dim=1)] @ self.text_projection


def _transformer(width, heads, layers):
    found = nn.Module()
    found.resblocks = nn.ModuleList()
    for _ in range(layers):
        block = nn.Module()
        block.ln_1, block.ln_2 = nn.LayerNorm(width), nn.LayerNorm(width)
        block.attn = nn.MultiheadAttention(width, heads, batch_first=True)
        nn.init.normal_(block.attn.in_proj_bias)
        block.mlp = nn.Module()
        block.mlp.c_fc, block.mlp.c_proj = nn.Linear(width, 2 * width), nn.Linear(2 * width, width)
        found.resblocks.append(block)
    return found


def _run(transformer, x, mask):
    for block in transformer.resblocks:
        y = block.ln_1(x)
        x = x + block.attn(y, y, y, attn_mask=mask, need_weights=False)[0]
        x = x + block.mlp.c_proj(nn.functional.gelu(block.mlp.c_fc(block.ln_2(x))))
    return x
