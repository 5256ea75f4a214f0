"""Sizes of the released vision transformers, from the config or the name of their weights."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from .._files import read_json

FLOAT = 4  # bytes


@dataclass(frozen=True)
class VitSizes:
    """Sizes of a plain vision transformer, as far as its cost depends on them."""

    width: int
    """Channels of a token."""
    depth: int
    """Blocks."""
    mlp: int
    """Hidden channels of a block's MLP."""
    patch: int
    """Side of a patch, pixels."""
    channels: int
    """D of a feature."""
    extra: int = 1
    """Class and register tokens."""
    gated: bool = False
    """Whether the MLP is gated (SwiGLU): three matrices instead of two."""

    @property
    def parameters(self) -> int:
        """Weights of the blocks and of the patch embedding; biases, norms and positions (below 1 %) are left out."""
        block = 4 * self.width**2 + (3 if self.gated else 2) * self.width * self.mlp
        return self.depth * block + 3 * self.patch**2 * self.width

    def flops(self, patches: int) -> float:
        """Operations for a picture of so many patches: 2 n (4 C^2 + 2 C M) + 4 n^2 C for each block of n tokens."""
        n = patches + self.extra
        products = 2.0 * n * (4 * self.width**2 + (3 if self.gated else 2) * self.width * self.mlp)
        return self.depth * (products + 4.0 * n**2 * self.width) + 2.0 * patches * 3 * self.patch**2 * self.width

    def peak_bytes(self, patches: int) -> int:
        """Weights, and what one block holds at a time: about 8 times its tokens, and the MLP's hidden ones twice."""
        tokens = patches + self.extra
        return FLOAT * (self.parameters + tokens * (8 * self.width + 2 * self.mlp))


_B, _L, _SO400M = (768, 12, 3072), (1024, 24, 4096), (1152, 27, 4304)
_HUGE, _GIANT = (1280, 32, 5120), (1536, 40, 4096)

# What the weights' name says -> sizes, per kind; the first pattern that is found counts, "" is what is assumed without any.
# "(?<![a-z])" and "(?![a-z])": a letter that stands alone, as the H of ViT-H-14, and not that of patch14.
RELEASED: dict[str, dict[str, VitSizes]] = {
    "clip": {
        "base-?patch32|(?<![a-z])b-?32": VitSizes(*_B, 32, 512),
        "large-?patch14|(?<![a-z])l-?14": VitSizes(*_L, 14, 768),
        "huge-?patch14|(?<![a-z])h-?14": VitSizes(*_HUGE, 14, 1024),
        "bigg": VitSizes(1664, 48, 8192, 14, 1280),
        "(?<![a-z])g-?14": VitSizes(1408, 40, 6144, 14, 1024),
        "base-?patch16|(?<![a-z])b-?16": VitSizes(*_B, 16, 512),
        "": VitSizes(*_B, 16, 512),
    },
    "siglip": {
        "so400m.*patch16": VitSizes(*_SO400M, 16, 1152, 0),
        "so400m": VitSizes(*_SO400M, 14, 1152, 0),
        "giant": VitSizes(1536, 40, 6144, 16, 1536, 0),
        "large": VitSizes(*_L, 16, 1024, 0),
        "base.*patch32": VitSizes(*_B, 32, 768, 0),
        "base": VitSizes(*_B, 16, 768, 0),
        "": VitSizes(*_B, 16, 768, 0),
    },
    "tipsv2": {
        "so400m": VitSizes(*_SO400M, 14, 1152, 2),
        "g14|giant": VitSizes(*_GIANT, 14, 1536, 2, gated=True),
        "l14|large": VitSizes(*_L, 14, 1024, 2),
        "b14|base": VitSizes(*_B, 14, 768, 2),
        "": VitSizes(*_B, 14, 768, 2),
    },
    "dinov2": {
        "small|vits": VitSizes(384, 12, 1536, 14, 384, 5),
        "large|vitl": VitSizes(*_L, 14, 1024, 5),
        "giant|vitg": VitSizes(*_GIANT, 14, 1536, 5, gated=True),
        "base|vitb": VitSizes(*_B, 14, 768, 5),
        "": VitSizes(*_B, 14, 768, 5),
    },
    "dinov3": {
        "vits16plus": VitSizes(384, 12, 1536, 16, 384, 5, gated=True),
        "vits": VitSizes(384, 12, 1536, 16, 384, 5),
        "vitl": VitSizes(*_L, 16, 1024, 5),
        "vith": VitSizes(*_HUGE, 16, 1280, 5, gated=True),
        "7b": VitSizes(4096, 40, 8192, 16, 4096, 5, gated=True),
        "vitb": VitSizes(*_B, 16, 768, 5),
        "": VitSizes(*_B, 16, 768, 5),
    },
    "radio": {
        "so400m": VitSizes(*_SO400M, 16, 1152, 8),
        "-b(?![a-z])|base": VitSizes(*_B, 16, 768, 8),
        "-l(?![a-z])|large": VitSizes(*_L, 16, 1024, 8),
        "-h(?![a-z])|huge": VitSizes(*_HUGE, 16, 1280, 8),
        "": VitSizes(*_HUGE, 16, 1280, 8),
    },
}
RELEASED["openclip"], RELEASED["siglip2"] = RELEASED["clip"], RELEASED["siglip"]

SAM_SIZES: dict[str, tuple[int, int, int]] = {  # width, depth, heads
    "vit_b": (768, 12, 12),
    "vit_l": (1024, 24, 16),
    "vit_h": (1280, 32, 16),
}
_OPENCLIP = "open_clip"  # how files in OpenCLIP's layout begin, which do not name their model


def vit_sizes(kind: str, weights: str | Path | None) -> tuple[VitSizes, bool]:
    """Sizes of a teacher over transformers, and whether they are only assumed.

    Args:
        kind: a key of `RELEASED`.
        weights: a folder with config.json, which is read; otherwise the last part of the name decides ("...large-patch14"),
            for `open_clip_*` the name of its folder. If the name has no size, or is None, a common size is assumed.

    Raises:
        ValueError: if config.json is not of a vision transformer.
    """
    config = None if weights is None else Path(weights).expanduser() / "config.json"
    if config is not None and config.is_file():
        return _sizes_of_config(kind, config), False
    named = last_name(weights).lower().replace("_", "-")
    pattern, sizes = next((pattern, sizes) for pattern, sizes in RELEASED[kind].items() if re.search(pattern, named))
    return sizes, pattern == ""


def sam_sizes(weights: str | Path | None) -> tuple[tuple[int, int, int], bool]:
    """Width, depth and heads of SAM's encoder by the name of its checkpoint, and whether they are only assumed."""
    named = last_name(weights).lower().replace("-", "_")
    found = next((sizes for kind, sizes in SAM_SIZES.items() if kind in named), None)
    return found or SAM_SIZES["vit_b"], found is None


def last_name(weights: str | Path | None) -> str:
    """The part of a path or hub id that names the model: folders above it may be called anything."""
    path = Path(weights or "")
    return path.parent.name if path.name.startswith(_OPENCLIP) else path.name


def _sizes_of_config(kind: str, path: Path) -> VitSizes:
    found = read_json(path)
    vision = found.get("vision_config", found) if isinstance(found, dict) else {}
    usual = RELEASED[kind][""]
    try:
        width, patch = int(vision["hidden_size"]), vision["patch_size"]
        patch = int(patch) if isinstance(patch, int) else int(patch[0])
        depth = int(vision["num_hidden_layers"])
        mlp = int(vision.get("intermediate_size") or width * vision.get("mlp_ratio", 4))
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise ValueError(
            f"{path}: expected hidden_size, patch_size and num_hidden_layers of a vision transformer, got none ({error!r}); "
            f"give the folder of a {kind} model, as save_pretrained writes it"
        ) from error
    projected = found.get("projection_dim") if kind in ("clip", "openclip") else None
    registers = vision.get("num_register_tokens")
    extra = usual.extra if registers is None else 1 + int(registers)
    gated = bool(vision.get("use_swiglu_ffn", vision.get("use_gated_mlp", False)))
    return VitSizes(width, depth, mlp, patch, int(projected or width), extra, gated)
