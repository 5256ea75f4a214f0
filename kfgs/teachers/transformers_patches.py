"""Turn the patch tokens of a vision transformer into features comparable with text, one function per kind of head.

Every function takes a model of transformers and one picture, and returns its patch tokens [1, h*w, D], row by row,
without class and register tokens.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

Patches = Callable[[Any, Tensor, bool], Tensor]  # (model, pixels [1, 3, H, W], residual) -> [1, h*w, D]


def vision_of(model: Any) -> Any:
    """The image tower of a model with two towers, or the model itself."""
    return getattr(model, "vision_model", model)


def patch_size(model: Any) -> tuple[int, int]:
    """(height, width) of a patch in pixels."""
    found = vision_of(model).config.patch_size
    return (found, found) if isinstance(found, int) else (int(found[0]), int(found[1]))


@contextmanager
def values_only(attention: nn.Module, projection: nn.Module) -> Iterator[list[Tensor]]:
    """Inside the `with` block, `attention` returns the projected value of each token, out(v(x)): no token sees another.

    The values are also added to the yielded list, in the order of the calls. MaskCLIP does this in the last block of CLIP
    (Zhou et al. 2022), because the pooled token is a mean of these values.
    """
    values: list[Tensor] = []

    def replace(module: Any, inputs: tuple[Any, ...], named: dict[str, Any], _: Any) -> tuple[Tensor, None]:
        hidden = inputs[0] if inputs else named["hidden_states"]
        values.append(projection(module.v_proj(hidden)))
        return values[-1], None

    handle = attention.register_forward_hook(replace, with_kwargs=True)
    try:
        yield values
    finally:
        handle.remove()


def clip_patches(model: Any, pixels: Tensor, residual: bool) -> Tensor:
    """CLIP: the values of the last block, through the last norm and the projection into the text's space.

    `residual` keeps that block's residual connection and MLP, as MaskCLIP's own code does; F3RM found them harmful.
    """
    vision = vision_of(model)
    attention = vision.encoder.layers[-1].self_attn
    with values_only(attention, attention.out_proj) as values:
        hidden = vision(pixels, interpolate_pos_encoding=True).last_hidden_state
    tokens = hidden if residual else values[0]
    return model.visual_projection(vision.post_layernorm(tokens))[:, 1:]


def siglip_patches(model: Any, pixels: Tensor, residual: bool) -> Tensor:
    """SigLIP: each patch alone through the pooling head."""
    vision = vision_of(model)
    return _pool_each(vision, vision(pixels, interpolate_pos_encoding=True).last_hidden_state)


def naflex_patches(model: Any, pixels: Tensor, residual: bool) -> Tensor:
    """SigLIP 2 for pictures of any shape (NaFlex), with flattened patches: [h*w, rows * columns * RGB]."""
    vision = vision_of(model)
    ph, pw = patch_size(model)
    _, C, H, W = pixels.shape  # one picture
    h, w = H // ph, W // pw
    patches = pixels.reshape(1, C, h, ph, w, pw).permute(0, 2, 4, 3, 5, 1).reshape(1, h * w, ph * pw * C)
    mask = torch.ones(1, h * w, dtype=torch.long, device=pixels.device)
    shapes = torch.tensor([[h, w]], device=pixels.device)
    hidden = vision(patches, pixel_attention_mask=mask, spatial_shapes=shapes).last_hidden_state
    return _pool_each(vision, hidden)


def tips_patches(model: Any, pixels: Tensor, residual: bool) -> Tensor:
    """TIPS: the last hidden state; `residual`: the values of the last block, with its residual and MLP.

    The authors use `residual` to segment without training.
    """
    vision = vision_of(model)
    if not residual:
        return last_patches(model, pixels, residual)
    attention = vision.encoder.layer[-1].attention
    with values_only(attention, attention.o_proj):
        return last_patches(model, pixels, residual)


def last_patches(model: Any, pixels: Tensor, residual: bool) -> Tensor:
    """The last hidden state, after its norm, without the class token and the registers."""
    vision = vision_of(model)
    skipped = 1 + getattr(vision.config, "num_register_tokens", 0)
    return vision(pixels).last_hidden_state[:, skipped:]


def radio_patches(model: Any, pixels: Tensor, residual: bool) -> Tensor:
    """RADIO: its spatial features."""
    return model(pixels).features


def _pool_each(vision: Any, hidden: Tensor) -> Tensor:  # [1, T, D] -> [1, T, D]
    """The pooling head for each token alone, with all attention on it: v = out(W_v h + b_v); v + MLP(LN(v))."""
    head = vision.head
    D = hidden.shape[-1]
    weight, bias = head.attention.in_proj_weight[2 * D :], head.attention.in_proj_bias[2 * D :]
    values = head.attention.out_proj(nn.functional.linear(hidden, weight, bias))
    return values + head.mlp(head.layernorm(values))
