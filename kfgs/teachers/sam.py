"""Segment Anything's image encoder as a teacher, over kornia: 256 channels on a grid of 64 cells along the longer side."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from kornia.enhance import normalize as normalize_picture
from kornia.models.sam import Sam, SamConfig
from torch import Tensor, nn
from torch.nn.functional import pad

from .._files import as_path, digest_file
from .checkpoint import read_checkpoint
from .protocol import check_picture
from .transformers_teacher import resize_picture

_SIDE = 1024  # pixels of the square that the encoder sees
_GRID = 64  # cells of its map
_MEAN, _STD = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)  # of bytes
_PREFIX = "image_encoder."


def load_sam(source: str | Path) -> SamTeacher:
    """Load the image encoder from a checkpoint of Segment Anything 1 or MobileSAM, as published; nothing in it is run.

    The shapes of the weights show which one it is: `sam_vit_b_01ec64.pth`, `sam_vit_l_0b3195.pth`, `sam_vit_h_4b8939.pth`
    or `mobile_sam.pt`.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is damaged, or not a checkpoint of SAM; the message names missing weights.
    """
    path = as_path(source)
    state = {
        name.removeprefix(_PREFIX): tensor.float() if tensor.is_floating_point() else tensor
        for name, tensor in read_checkpoint(path).items()
        if name.startswith(_PREFIX)
    }
    if not state:
        raise ValueError(
            f"{path}: expected a checkpoint of Segment Anything, with weights {_PREFIX}..., got none of these; use "
            "sam_vit_b_01ec64.pth or another of SAM 1 (not 2 or 3)"
        )
    try:
        config = _config_of(state)
        # Initialising 637 M weights takes long; but TinyViT computes a table of indices that no checkpoint holds.
        with torch.device("meta" if config.model_type is None else "cpu"):
            encoder = Sam.from_config(config).image_encoder
        encoder.load_state_dict(state, assign=True)
    except (
        KeyError,
        ZeroDivisionError,
        RuntimeError,
    ) as error:  # which lists missing, unexpected and misshapen tensors
        wrong = " ".join(str(error).split())
        raise ValueError(
            f"{path}: expected the weights of SAM's image encoder, got others ({wrong:.300}); use a checkpoint of SAM 1 as it "
            "was published"
        ) from error
    identity = {"name": "sam", "options": {}, "weights": digest_file(path)}
    return SamTeacher(encoder.eval().requires_grad_(False), identity)


class SamTeacher:
    """SAM's image encoder, without a text encoder; made by `load_sam`.

    The longer side of a picture is resized to 1024, the picture is padded to a square at the bottom or right, and the
    padding is cut from the map, as in Feature 3DGS: a picture wider than high gives [256, int(64 H / W + 0.5), 64].
    """

    name = "sam"

    def __init__(self, encoder: nn.Module, identity: dict[str, Any]) -> None:
        self.encoder, self.identity = encoder, identity

    def __repr__(self) -> str:
        return f"SamTeacher(device={next(self.encoder.parameters()).device})"

    def to(self, device: torch.device | str) -> SamTeacher:
        """Move the encoder to a device; features are computed and returned there."""
        self.encoder.to(device)
        return self

    @torch.inference_mode()
    def encode_image(self, image: Tensor) -> Tensor:  # [3, H, W] RGB in [0, 1] -> [256, h, w], the longer of h, w is 64
        """One feature per cell, not normalised."""
        check_picture(image)
        weight = next(self.encoder.parameters())
        height, width = _scaled(image, _SIDE)
        pixels = resize_picture(image.to(weight.device, weight.dtype), (height, width))[None]
        mean, std = (weight.new_tensor(values) / 255 for values in (_MEAN, _STD))
        pixels = pad(normalize_picture(pixels, mean, std), (0, _SIDE - width, 0, _SIDE - height))
        rows, columns = _scaled(image, _GRID)
        return self.encoder(pixels)[0, :, :rows, :columns].float().contiguous()

    def encode_text(self, prompts: Sequence[str]) -> Tensor:
        """Always raises a NotImplementedError: SAM has no text encoder."""
        raise NotImplementedError(
            "teacher 'sam': expected one with a text encoder, got one that sees only pictures; use clip, siglip, tipsv2 or "
            "lseg for words, or query it by examples"
        )


def _scaled(image: Tensor, longest: int) -> tuple[int, int]:
    """(height, width) of a picture whose longer side becomes `longest`."""
    H, W = image.shape[1:]
    scale = longest / max(H, W)
    return max(1, int(scale * H + 0.5)), max(1, int(scale * W + 0.5))


def _config_of(state: dict[str, Tensor]) -> SamConfig:
    """The encoder's sizes: width, depth, heads, and which blocks see the whole picture."""
    if "patch_embed.seq.0.c.weight" in state:
        return SamConfig("mobile_sam")
    width = state["patch_embed.proj.weight"].shape[0]
    blocks = {int(match[1]) for name in state if (match := re.match(r"blocks\.(\d+)\.", name))}
    positions = {i: state[f"blocks.{i}.attn.rel_pos_h"] for i in blocks}  # [2 side - 1, channels of a head]
    return SamConfig(
        encoder_embed_dim=width,
        encoder_depth=len(blocks),
        encoder_num_heads=width // positions[0].shape[1],
        encoder_global_attn_indexes=tuple(i for i in sorted(blocks) if positions[i].shape[0] == 2 * _GRID - 1),
    )
