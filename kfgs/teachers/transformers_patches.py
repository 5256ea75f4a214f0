"""Turn the patch tokens of a vision transformer into features comparable with text, one function per kind of head.

Every function takes a model of transformers and one picture, and returns its patch tokens [1, h*w, D], row by row,
without class and register tokens.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor, nn

Patches = Callable[[Any, Tensor], Tensor]  # (model, pixels [1, 3, H, W]) -> [1, h*w, D]


def vision_of(model: Any) -> Any:
    """The image tower of a model with two towers, or the model itself."""
    return getattr(model, "vision_model", model)


def patch_size(model: Any) -> tuple[int, int]:
    """(height, width) of a patch in pixels."""
    size = vision_of(model).config.patch_size
    return (size, size) if isinstance(size, int) else (int(size[0]), int(size[1]))


def clip_patches(model: Any, pixels: Tensor) -> Tensor:
    """CLIP: the values of the last block, out(v(x)), through the last norm and the projection into the text's space.

    No token sees another in that block, and its residual connection and MLP are left out: the pooled token is a mean of these
    values (MaskCLIP, Zhou et al. 2022), and F3RM found the rest harmful.
    """
    vision = vision_of(model)
    attention = vision.encoder.layers[-1].self_attn
    values: list[Tensor] = []

    def keep_values(module: Any, inputs: tuple[Any, ...], named: dict[str, Any]) -> None:
        hidden = inputs[0] if inputs else named["hidden_states"]
        values.append(attention.out_proj(attention.v_proj(hidden)))

    handle = attention.register_forward_pre_hook(keep_values, with_kwargs=True)
    try:
        vision(pixels, interpolate_pos_encoding=True)
    finally:
        handle.remove()
    return model.visual_projection(vision.post_layernorm(values[0]))[:, 1:]


def siglip_patches(model: Any, pixels: Tensor) -> Tensor:
    """SigLIP: the pooling head for each patch alone, with all attention on it: v = out(W_v h + b_v); v + MLP(LN(v))."""
    vision = vision_of(model)
    hidden = vision(pixels, interpolate_pos_encoding=True).last_hidden_state  # [1, h*w, D]
    head, D = vision.head, hidden.shape[-1]
    weight, bias = head.attention.in_proj_weight[2 * D :], head.attention.in_proj_bias[2 * D :]
    values = head.attention.out_proj(nn.functional.linear(hidden, weight, bias))
    return values + head.mlp(head.layernorm(values))


def last_patches(model: Any, pixels: Tensor) -> Tensor:
    """TIPS, DINO: the last hidden state, after its norm, without the class token and the registers."""
    vision = vision_of(model)
    skipped = 1 + getattr(vision.config, "num_register_tokens", 0)
    return vision(pixels).last_hidden_state[:, skipped:]


def radio_patches(model: Any, pixels: Tensor) -> Tensor:
    """RADIO: its spatial features."""
    return model(pixels).features
