"""What a checkpoint of LSeg holds: every tensor's name and shape, and seeded random weights in that layout.

The released `demo_e200.ckpt` has 730 tensors with the prefix `net.`: the ViT, the decoder, and the whole CLIP ViT-B/32 that
was trained beside them, whose picture tower is not used.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kfgs.teachers.lseg import LSegConfig

_PREFIX = "net."
_CLASSES = 1000  # rows of the ViT's unused head, of ImageNet
_CLIP_PATCH, _CLIP_TOKENS = 32, 50  # of the unused picture tower: 224 / 32 squared, and the class token
_HALF = (".attn.", ".mlp.", "visual.conv1.weight", "visual.proj", ".text_projection")  # what CLIP keeps in float16


# A tiny LSeg: every part of the network, in milliseconds.
TINY = LSegConfig(
    width=32, depth=4, heads=4, window=64, position_grid=3, hooks=(0, 1, 2, 3), neck=(8, 12, 16, 20), fusion=12, dim=16,
    text_width=32, text_layers=2, text_heads=4,
)  # fmt: skip


def layout(config: LSegConfig) -> dict[str, tuple[int, ...]]:
    """Name and shape of every tensor of a checkpoint whose network has these sizes: 730 with the default ones.

    CLIP's picture tower, which no feature depends on, is 3/2 as wide as the text tower and as deep, as in ViT-B/32.
    """
    shapes = _clip(config) | _vit(config) | _decoder(config)
    return {_PREFIX + name: shape for name, shape in shapes.items()}


def random_state(
    config: LSegConfig, generator: torch.Generator | None = None, *, half_text: bool = True
) -> dict[str, Tensor]:
    """Random weights in the layout of a checkpoint, drawn so that activations keep their order of magnitude.

    Matrices are normal with variance 1 / fan-in, gains of norms lie around 1, offsets around 0 and variances in [0.5, 1.5].

    Args:
        config: sizes of the network.
        generator: source of randomness (CPU).
        half_text: CLIP's matrices and their offsets in float16, as in the released file: 195 tensors by default.
    """
    state: dict[str, Tensor] = {}
    for name, shape in layout(config).items():
        value = _draw(name, shape, generator)
        clip = name.startswith(f"{_PREFIX}clip_pretrained.")
        state[name] = value.half() if half_text and clip and any(part in name for part in _HALF) else value
    return state


def _draw(name: str, shape: tuple[int, ...], generator: torch.Generator | None) -> Tensor:
    if name.endswith("num_batches_tracked"):
        return torch.tensor(1000)  # int64
    if name.endswith("logit_scale"):
        return torch.tensor(math.log(100.0))
    if name.endswith("running_var"):
        return torch.rand(shape, generator=generator) + 0.5
    value = torch.randn(shape, generator=generator)
    if name.endswith(("token", "pos_embed", "embedding", "token_embedding.weight")):
        return value.mul_(0.5)
    if len(shape) == 1:  # norms and offsets
        value.mul_(0.1)
        return value.add_(1.0) if name.endswith("weight") else value
    transposed = name.endswith(("projection", ".proj")) or (".act_postprocess" in name and shape[-1] in (2, 4))
    fan_in = shape[0] if transposed else math.prod(shape[1:])
    return value.mul_(fan_in**-0.5)


def _linear(name: str, out: int, into: int, *kernel: int) -> dict[str, tuple[int, ...]]:
    return {f"{name}.weight": (out, into, *kernel), f"{name}.bias": (out,)}


def _norm(name: str, width: int) -> dict[str, tuple[int, ...]]:
    return {f"{name}.weight": (width,), f"{name}.bias": (width,)}


def _clip_blocks(name: str, width: int, layers: int) -> dict[str, tuple[int, ...]]:
    shapes: dict[str, tuple[int, ...]] = {}
    for i in range(layers):
        block = f"{name}.transformer.resblocks.{i}"
        shapes |= {f"{block}.attn.in_proj_weight": (3 * width, width), f"{block}.attn.in_proj_bias": (3 * width,)}
        shapes |= _linear(f"{block}.attn.out_proj", width, width)
        shapes |= _norm(f"{block}.ln_1", width)
        shapes |= _linear(f"{block}.mlp.c_fc", 4 * width, width) | _linear(f"{block}.mlp.c_proj", width, 4 * width)
        shapes |= _norm(f"{block}.ln_2", width)
    return shapes


def _clip(config: LSegConfig) -> dict[str, tuple[int, ...]]:
    """CLIP ViT-B/32, both towers."""
    width, picture_width = config.text_width, 3 * config.text_width // 2
    shapes: dict[str, tuple[int, ...]] = {
        "positional_embedding": (config.context, width),
        "text_projection": (width, config.dim),
        "logit_scale": (),
        "visual.class_embedding": (picture_width,),
        "visual.positional_embedding": (_CLIP_TOKENS, picture_width),
        "visual.proj": (picture_width, config.dim),
        "visual.conv1.weight": (picture_width, 3, _CLIP_PATCH, _CLIP_PATCH),
        "token_embedding.weight": (config.vocabulary, width),
    }
    shapes |= _norm("visual.ln_pre", picture_width) | _norm("visual.ln_post", picture_width)
    shapes |= _norm("ln_final", width) | {
        name.removeprefix("."): shape for name, shape in _clip_blocks("", width, config.text_layers).items()
    }
    shapes |= _clip_blocks("visual", picture_width, config.text_layers)
    return {f"clip_pretrained.{name}": shape for name, shape in shapes.items()}


def _vit(config: LSegConfig) -> dict[str, tuple[int, ...]]:
    """The ViT, in timm's names."""
    width = config.width
    shapes: dict[str, tuple[int, ...]] = {
        "cls_token": (1, 1, width),
        "pos_embed": (1, config.position_grid**2 + 1, width),
    }
    shapes |= _linear("patch_embed.proj", width, 3, 16, 16)
    for i in range(config.depth):
        shapes |= _norm(f"blocks.{i}.norm1", width) | _norm(f"blocks.{i}.norm2", width)
        shapes |= _linear(f"blocks.{i}.attn.qkv", 3 * width, width) | _linear(f"blocks.{i}.attn.proj", width, width)
        shapes |= _linear(f"blocks.{i}.mlp.fc1", 4 * width, width) | _linear(f"blocks.{i}.mlp.fc2", width, 4 * width)
    shapes |= _norm("norm", width) | _linear("head", _CLASSES, width)
    return {f"pretrained.model.{name}": shape for name, shape in shapes.items()}


def _decoder(config: LSegConfig) -> dict[str, tuple[int, ...]]:
    """DPT's decoder and the head of the features."""
    width, fusion = config.width, config.fusion
    shapes: dict[str, tuple[int, ...]] = {}
    for i, channels in enumerate(config.neck, start=1):
        name = f"pretrained.act_postprocess{i}"
        shapes |= _linear(f"{name}.0.project.0", width, 2 * width) | _linear(f"{name}.3", channels, width, 1, 1)
        if i != 3:  # two enlarge by transposed convolutions, one stays, one is halved
            kernel = {1: 4, 2: 2, 4: 3}[i]
            shapes |= _linear(f"{name}.4", channels, channels, kernel, kernel)
        shapes[f"scratch.layer{i}_rn.weight"] = (fusion, channels, 3, 3)
        block = f"scratch.refinenet{i}"
        shapes |= _linear(f"{block}.out_conv", fusion, fusion, 1, 1)
        for unit in (f"{block}.resConfUnit1", f"{block}.resConfUnit2"):
            for k in (1, 2):
                shapes[f"{unit}.conv{k}.weight"] = (fusion, fusion, 3, 3)
                shapes |= _norm(f"{unit}.bn{k}", fusion)
                shapes |= {f"{unit}.bn{k}.running_mean": (fusion,), f"{unit}.bn{k}.running_var": (fusion,)}
                shapes[f"{unit}.bn{k}.num_batches_tracked"] = ()
    return shapes | _linear("scratch.head1", config.dim, fusion, 1, 1)
