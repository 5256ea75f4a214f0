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

# Other networks by prefixes of their tensor names. The first rule that fits counts; LSeg's prefixes are checked before.
_BY_PREFIX = (
    (("student.", "teacher."), "a self-supervised training checkpoint (DINO, iBOT)"),
    (("image_encoder.", "mask_decoder.", "prompt_encoder.", "vision_encoder."), "a SAM checkpoint"),
    (("visual.", "transformer.resblocks.", "token_embedding."), "CLIP alone, without LSeg's decoder"),
    (("vision_model.", "text_model."), "CLIP or SigLIP of transformers, without LSeg's decoder"),
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
    unknown = [f"{one_line(name)} {tuple(value.shape)}" for name, value in state.items() if not _known(name, shapes)]
    other = [
        f"{name}: expected {shape}, got {tuple(state[name].shape)}"
        for name, shape in shapes.items()
        if name in state and tuple(state[name].shape) != shape
    ]
    other += [
        f"{name}: expected floating point, got {state[name].dtype}"
        for name, shape in shapes.items()
        if name in state and tuple(state[name].shape) == shape and not state[name].is_floating_point()
    ]
    if not (missing or unknown or other):
        return
    what = _recognise(state)
    hint = "pass that file"
    if what is None:
        lists = ((missing, "missing"), (unknown, "unknown"), (other, "of another shape or type"))
        parts = [f"{len(names)} {kind} ({_first(names)})" for names, kind in lists if names]
        what, hint = f"{len(state)} tensors, {', '.join(parts)}", "use the file as its authors published it"
    raise ValueError(f"{source}: expected {_EXPECTED}, got {what}; {hint}")


def _known(name: str, shapes: Mapping[str, tuple[int, ...]]) -> bool:
    return name in shapes or _UNUSED.match(name) is not None


def _first(names: list[str]) -> str:
    return "; ".join(names[:2]) + ("; ..." if len(names) > 2 else "")


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


def _recognise(state: Mapping[str, Tensor]) -> str | None:  # names without "net."
    """Name the other network that a state belongs to, by its tensor names; None if it is LSeg's, or unknown."""
    names = list(state)
    if not names:
        return "no tensors of its image network"
    if any(name.startswith("pretrained.layer1") for name in names):
        return "LSeg of backbone clip_resnet101, or another without a ViT"
    if any(name.startswith(("pretrained.", "scratch.")) for name in names):
        return _other_lseg(state)
    return next((what for prefixes, what in _BY_PREFIX if any(name.startswith(prefixes) for name in names)), None)


def _size(value: Tensor | None, axis: int) -> int | None:
    """A tensor's size along an axis, if it has that axis."""
    return value.shape[axis] if value is not None and -value.ndim <= axis < value.ndim else None


def _other_lseg(state: Mapping[str, Tensor]) -> str | None:
    patches, head = state.get("pretrained.model.patch_embed.proj.weight"), state.get("scratch.head1.weight")
    positions = state.get("pretrained.model.pos_embed")
    if _size(positions, -1) == 768:
        size = 16 if _size(patches, -1) == 16 else 32
        return f"LSeg of backbone clip_vitb{size}_384 (768 channels)"
    if _size(head, 0) == 768:
        return "LSeg of backbone clipRN50x16_vitl16_384 (features of 768 channels)"
    if head is None and any(name.startswith("scratch.output_conv.") for name in state):
        return "a DPT for depth or closed classes, without LSeg's head"
    return None
