"""Build LSeg's networks on the tensors of its checkpoint, whose names are translated here."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from ..._check import one_line
from ..transformers_openclip import load_text_tower
from .network import LSegConfig, LSegNetwork

_EXPECTED = "the LSeg checkpoint of backbone clip_vitl16_384 (demo_e200.ckpt)"
_POSITIONS = "vit.patch_embedding.positions"
_COUNTER = "num_batches_tracked"
_TEXT = "clip_pretrained."

# Our names as patterns, and LSeg's. Levels count from 1 there, from 0 here (`{1+}` adds one).
_NAMES = (
    (r"vit\.patch_embedding\.cls_token", "pretrained.model.cls_token"),
    (r"vit\.patch_embedding\.positions", "pretrained.model.pos_embed"),
    (r"vit\.patch_embedding\.backbone\.", "pretrained.model.patch_embed.proj."),
    (r"vit\.encoder\.blocks\.(\d+)\.0\.fn\.0\.", r"pretrained.model.blocks.\1.norm1."),
    (r"vit\.encoder\.blocks\.(\d+)\.0\.fn\.1\.qkv\.", r"pretrained.model.blocks.\1.attn.qkv."),
    (r"vit\.encoder\.blocks\.(\d+)\.0\.fn\.1\.projection\.", r"pretrained.model.blocks.\1.attn.proj."),
    (r"vit\.encoder\.blocks\.(\d+)\.1\.fn\.0\.", r"pretrained.model.blocks.\1.norm2."),
    (r"vit\.encoder\.blocks\.(\d+)\.1\.fn\.1\.0\.", r"pretrained.model.blocks.\1.mlp.fc1."),
    (r"vit\.encoder\.blocks\.(\d+)\.1\.fn\.1\.3\.", r"pretrained.model.blocks.\1.mlp.fc2."),
    (r"reassemble\.(\d)\.project\.", r"pretrained.act_postprocess{\1+}.0.project.0."),
    (r"reassemble\.(\d)\.expand\.", r"pretrained.act_postprocess{\1+}.3."),
    (r"reassemble\.(\d)\.resize\.", r"pretrained.act_postprocess{\1+}.4."),
    (r"reassemble\.(\d)\.narrow\.", r"scratch.layer{\1+}_rn."),
    (r"fusion\.(\d)\.unit(\d)\.", r"scratch.refinenet{\1+}.resConfUnit\2."),
    (r"fusion\.(\d)\.out\.", r"scratch.refinenet{\1+}.out_conv."),
    (r"head\.", "scratch.head1."),
)
# In the checkpoint, without any effect on the features: CLIP, the ViT's last norm and classes, the part of the coarsest
# fusion that has nothing to fuse, counters, and blocks that act on the logits (arch_option 1 and 2).
_UNUSED = re.compile(
    r"clip_pretrained\.|pretrained\.model\.(norm|head)\.|scratch\.refinenet4\.resConfUnit1\."
    r"|scratch\.head_block\.|logit_scale$|.*\.num_batches_tracked$"
)


def network_from_state(state: Mapping[str, Tensor], config: LSegConfig, *, source: str) -> LSegNetwork:
    """Build the image network on the tensors of a checkpoint, in evaluation mode and without gradients.

    float32 tensors are used as they are, not copied, so those of a memory-mapped file are read when first needed;
    others are cast to float32. The position embeddings are resized to the window's grid, bilinear, align_corners=False.
    A ValueError names tensors of `source` that are missing, unknown, of another shape or no floats.
    """
    state = _stripped(state)
    with torch.device("meta"):
        network = LSegNetwork(config)
    own = network.state_dict()
    names = {name: _lseg_name(name) for name in own if not name.endswith(_COUNTER)}
    shapes = {theirs: tuple(own[name].shape) for name, theirs in names.items()}
    shapes[names[_POSITIONS]] = (1, 1 + config.position_grid**2, config.width)
    _check(state, shapes, source)
    tensors = {name: state[theirs].detach().to(torch.float32) for name, theirs in names.items()}
    tensors[_POSITIONS] = _resize_positions(tensors[_POSITIONS], config.position_grid, config.grid)
    counters = {name: torch.tensor(0) for name in own if name.endswith(_COUNTER)}
    network.requires_grad_(False).load_state_dict({**tensors, **counters}, assign=True)
    return network.eval()


def text_from_state(state: Mapping[str, Tensor], config: LSegConfig, *, source: str) -> Any:
    """The text tower of a checkpoint, which is CLIP ViT-B/32's, as transformers' CLIPTextModelWithProjection."""
    every = _stripped(state)
    tower = {name.removeprefix(_TEXT): value for name, value in every.items() if name.startswith(_TEXT)}
    if not tower:
        raise ValueError(
            f"{source}: expected CLIP's text tower in it ({_TEXT}*), got {len(every)} tensors without it; use the "
            "whole demo_e200.ckpt to embed prompts, or give the rows to LabelSet"
        )
    return load_text_tower(source, tower, config.text_heads).requires_grad_(False)


def _stripped(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix("net."): value for name, value in state.items()}


def _lseg_name(own: str) -> str:
    """LSeg's name of one of our tensors."""
    fits = [re.sub(f"^{pattern}", theirs, own) for pattern, theirs in _NAMES if re.match(pattern, own)]
    assert len(fits) == 1, own
    return re.sub(r"\{(\d)\+\}", lambda match: str(int(match[1]) + 1), fits[0])


def _check(state: Mapping[str, Tensor], shapes: Mapping[str, tuple[int, ...]], source: str) -> None:
    """Raise unless the state holds float tensors of these names and shapes. Tensors known to be unused may be there too."""
    missing = [f"{name} {shape}" for name, shape in shapes.items() if name not in state]
    unknown = [one_line(name) for name in state if name not in shapes and not _UNUSED.match(name)]
    other = [
        f"{name}: expected {shape}, got {tuple(state[name].shape)} of {state[name].dtype}"
        for name, shape in shapes.items()
        if name in state and not (tuple(state[name].shape) == shape and state[name].is_floating_point())
    ]
    lists = ((missing, "missing"), (unknown, "unknown"), (other, "of another shape or type"))
    wrong = "".join(f", {len(names)} {kind} ({'; '.join(names[:2])})" for names, kind in lists if names)
    if wrong:
        got = f"another network of {len(state)} tensors{wrong}"
        raise ValueError(f"{source}: expected {_EXPECTED}, got {got}; use the file as its authors published it")


def _resize_positions(positions: Tensor, side: int, grid: int) -> Tensor:
    """The table [1, 1 + side * side, width] for a grid of another side: [1 + grid * grid, width], the first row kept."""
    readout, patches = positions[0, :1], positions[0, 1:]
    if side == grid:
        return positions[0]
    square = patches.T.unflatten(1, (side, side))[None]  # [1, width, side, side]
    resized = functional.interpolate(square, size=(grid, grid), mode="bilinear", align_corners=False)
    return torch.cat([readout, resized[0].flatten(1).T])
