"""Map the tensor names of LSeg's checkpoint to `LSegNetwork` and `ClipText`; errors say which network a wrong file has."""

from __future__ import annotations

import re
from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional

from ..._check import one_line
from .network import LSegConfig, LSegNetwork
from .text import ClipText

_EXPECTED = "the LSeg checkpoint of backbone clip_vitl16_384 (demo_e200.ckpt)"
_POSITIONS = "vit.patch_embedding.positions"
_COUNTER = "num_batches_tracked"
_TEXT = "clip_pretrained."

# Our names as patterns, and LSeg's. Levels count from 1 there, from 0 here (`{1+}` adds one).
_IMAGE_NAMES = (
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
_TEXT_NAMES = (
    (r"token_embedding\.", "clip_pretrained.token_embedding."),
    (r"positions", "clip_pretrained.positional_embedding"),
    (r"projection$", "clip_pretrained.text_projection"),
    (r"norm\.", "clip_pretrained.ln_final."),
    (r"blocks\.(\d+)\.qkv\.", r"clip_pretrained.transformer.resblocks.\1.attn.in_proj_"),
    (r"blocks\.(\d+)\.projection\.", r"clip_pretrained.transformer.resblocks.\1.attn.out_proj."),
    (r"blocks\.(\d+)\.norm(\d)\.", r"clip_pretrained.transformer.resblocks.\1.ln_\2."),
    (r"blocks\.(\d+)\.fc1\.", r"clip_pretrained.transformer.resblocks.\1.mlp.c_fc."),
    (r"blocks\.(\d+)\.fc2\.", r"clip_pretrained.transformer.resblocks.\1.mlp.c_proj."),
)
# In the checkpoint, without any effect on the features: CLIP's image tower, the ViT's last norm and classes, the part of
# the coarsest fusion that has nothing to fuse, counters, and blocks that act on the logits (arch_option 1 and 2).
_UNUSED = re.compile(
    r"clip_pretrained\.(visual\.|logit_scale$)|pretrained\.model\.(norm|head)\.|scratch\.refinenet4\.resConfUnit1\."
    r"|scratch\.head_block\.|logit_scale$|.*\.num_batches_tracked$"
)

# Other networks by prefixes of their tensor names. The first rule that fits counts; LSeg's own are checked before.
_OTHERS = (
    (("pretrained.layer1",), "LSeg of backbone clip_resnet101, or another without a ViT"),
    (("pretrained.", "scratch."), None),
    (("student.", "teacher."), "a self-supervised training checkpoint (DINO, iBOT)"),
    (("image_encoder.", "mask_decoder.", "vision_encoder."), "a SAM checkpoint"),
    (("visual.", "transformer.resblocks.", "vision_model.", "text_model."), "CLIP alone, without LSeg's decoder"),
    (("conv1.", "layer1."), "a ResNet"),
    (("blocks.", "patch_embed.", "encoder.layer.", "embeddings."), "a ViT alone (DINO, timm), without LSeg's decoder"),
)


def network_from_state(state: Mapping[str, Tensor], config: LSegConfig, *, source: str) -> LSegNetwork:
    """Build the image network on the tensors of a checkpoint, in evaluation mode and without gradients.

    float32 tensors are used as they are, not copied, so those of a memory-mapped file are read when first needed;
    others are cast to float32. The position embeddings are resized to the window's grid, bilinear, align_corners=False.

    Args:
        state: tensors by name, with or without LSeg's prefix `net.`.
        config: sizes.
        source: the file's name, for messages.

    Raises:
        ValueError: if tensors are missing, unknown, of another shape or no floats; the message guesses the network.
    """
    state = _stripped(state)
    with torch.device("meta"):
        network = LSegNetwork(config)
    names = _names(network, _IMAGE_NAMES)
    shapes = _shapes(network, names)
    shapes[names[_POSITIONS]] = (1, 1 + config.position_grid**2, config.width)
    _check({name: value for name, value in state.items() if not name.startswith(_TEXT)}, shapes, source)
    tensors = _as_float(state, names)
    tensors[_POSITIONS] = _resize_positions(tensors[_POSITIONS], config.position_grid, config.grid)
    _fill(network, tensors)
    return network


def text_from_state(state: Mapping[str, Tensor], config: LSegConfig, *, source: str) -> ClipText:
    """Build the text tower on the tensors of a checkpoint, like `network_from_state`.

    Raises:
        ValueError: if the file holds no text tower, or one of other sizes.
    """
    every = _stripped(state)
    state = {name: value for name, value in every.items() if name.startswith(_TEXT)}
    if not state:
        raise ValueError(
            f"{source}: expected CLIP's text tower in it ({_TEXT}*), got {len(every)} tensors without it; use the "
            "whole demo_e200.ckpt to embed prompts, or give the rows to LabelSet"
        )
    with torch.device("meta"):
        tower = ClipText(config)
    names = _names(tower, _TEXT_NAMES)
    shapes = _shapes(tower, names)
    _check(state, shapes, source)
    _fill(tower, _as_float(state, names))
    return tower


def _stripped(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix("net."): value for name, value in state.items()}


def _names(module: nn.Module, table: tuple[tuple[str, str], ...]) -> dict[str, str]:
    """LSeg's name of each of a module's own tensors, counters left out."""
    names = {}
    for own in module.state_dict():
        if own.endswith(_COUNTER):
            continue
        found = [re.sub(f"^{pattern}", theirs, own) for pattern, theirs in table if re.match(pattern, own)]
        assert len(found) == 1, own
        names[own] = re.sub(r"\{(\d)\+\}", lambda match: str(int(match[1]) + 1), found[0])
    return names


def _shapes(module: nn.Module, names: Mapping[str, str]) -> dict[str, tuple[int, ...]]:
    own = module.state_dict()
    return {theirs: tuple(own[name].shape) for name, theirs in names.items()}


def _check(state: Mapping[str, Tensor], shapes: Mapping[str, tuple[int, ...]], source: str) -> None:
    """Raise unless the state holds float tensors of these names and shapes. Tensors known to be unused may be there too."""
    missing = [f"{name} {shape}" for name, shape in shapes.items() if name not in state]
    unknown = [one_line(name) for name in state if name not in shapes and not _UNUSED.match(name)]
    other = [
        f"{name}: expected {shape}, got {tuple(state[name].shape)} of {state[name].dtype}"
        for name, shape in shapes.items()
        if name in state and not (tuple(state[name].shape) == shape and state[name].is_floating_point())
    ]
    if not (missing or unknown or other):
        return
    what = next((what for start, what in _OTHERS if any(name.startswith(start) for name in state)), None)
    if state.get("scratch.head1.weight", torch.zeros(0)).shape[:1] == (768,) or "scratch.output_conv.0.weight" in state:
        what = "LSeg or DPT of another backbone or head"
    if what is None:
        lists = ((missing, "missing"), (unknown, "unknown"), (other, "of another shape or type"))
        what = f"{len(state)} tensors"
        what += "".join(f", {len(names)} {kind} ({'; '.join(names[:2])})" for names, kind in lists if names)
    raise ValueError(f"{source}: expected {_EXPECTED}, got {what}; use the file as its authors published it")


def _as_float(state: Mapping[str, Tensor], names: Mapping[str, str]) -> dict[str, Tensor]:
    """Tensors by our names as float32, without a copy if they are float32 already."""
    return {own: state[theirs].detach().to(torch.float32) for own, theirs in names.items()}


def _resize_positions(positions: Tensor, side: int, grid: int) -> Tensor:
    """The table [1, 1 + side * side, width] for a grid of another side: [1 + grid * grid, width], the first row kept."""
    readout, patches = positions[0, :1], positions[0, 1:]
    if side == grid:
        return positions[0]
    square = patches.T.unflatten(1, (side, side))[None]  # [1, width, side, side]
    resized = functional.interpolate(square, size=(grid, grid), mode="bilinear", align_corners=False)
    return torch.cat([readout, resized[0].flatten(1).T])


def _fill(module: nn.Module, tensors: dict[str, Tensor]) -> None:
    """Give a module that was built without storage its tensors, in evaluation mode and without gradients."""
    counters = {name: torch.tensor(0) for name in module.state_dict() if name.endswith(_COUNTER)}
    module.requires_grad_(False).load_state_dict({**tensors, **counters}, assign=True)
    module.eval()
