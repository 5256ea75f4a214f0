"""Which network a checkpoint is of that is not LSeg's, as far as the names of its tensors tell."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

# The first rule of which some tensor's name begins with the prefix; LSeg's own prefixes come before.
_BY_PREFIX = (
    (("student.", "teacher."), "a self-supervised training checkpoint (DINO, iBOT)"),
    (("image_encoder.", "mask_decoder.", "prompt_encoder.", "vision_encoder."), "a SAM checkpoint"),
    (("visual.", "transformer.resblocks.", "token_embedding."), "CLIP alone, without LSeg's decoder"),
    (("vision_model.", "text_model."), "CLIP or SigLIP of transformers, without LSeg's decoder"),
    (("conv1.", "layer1."), "a ResNet"),
    (("blocks.", "patch_embed.", "encoder.layer.", "embeddings."), "a ViT alone (DINO, timm), without LSeg's decoder"),
)


def recognise(state: Mapping[str, Tensor]) -> str | None:  # names without "net."
    """What a state seems to be in words, or None if it looks like LSeg's of the expected backbone or like nothing known."""
    names = list(state)
    if not names:
        return "no tensors of its image network"
    if any(name.startswith("pretrained.layer1") for name in names):
        return "LSeg of backbone clip_resnet101, or another without a ViT"
    if any(name.startswith(("pretrained.", "scratch.")) for name in names):
        return _other_lseg(state)
    return next((what for prefixes, what in _BY_PREFIX if any(name.startswith(prefixes) for name in names)), None)


def _size(value: Tensor | None, axis: int) -> int | None:
    """A tensor's size along an axis, if it has such."""
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
