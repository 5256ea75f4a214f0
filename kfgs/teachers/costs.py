"""What a teacher costs per picture, known before it is loaded: size of its map, operations, memory.

Operations are counted as FlopCounterMode of torch does: two per multiply-add of a product or convolution, nothing else.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from .._check import check_range, check_whole
from .._files import read_json

_FLOAT = 4  # bytes
_SAM_PIXELS, _SAM_PATCH, _SAM_WINDOW, _SAM_CHANNELS, _SAM_GLOBAL = 1024, 16, 14, 256, 4


@dataclass(frozen=True)
class TeacherCost:
    """One picture through a teacher. None: not known."""

    name: str
    channels: int | None
    """D of a feature."""
    map_size: tuple[int, int] | None
    """(h, w) of the map."""
    flops: float | None
    """Operations per picture, 2 per multiply-add."""
    parameters_bytes: int | None
    """Weights of the image network in float32."""
    peak_bytes: int | None
    """Memory while a picture is encoded: weights, activations and the map, without what Python and torch take."""
    forwards: int = 1
    """How often the network runs for a picture."""

    @classmethod
    def unknown(cls, name: str) -> TeacherCost:
        """A teacher about which nothing is known."""
        return cls(name, None, None, None, None, None)

    @classmethod
    def of_maps(cls, name: str, shape: tuple[int, int, int]) -> TeacherCost:
        """Maps (h, w, D) that are there already: no work is left for a teacher."""
        h, w, channels = shape
        return cls(name, channels, (h, w), 0.0, 0, 0, 0)


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
        return _FLOAT * (self.parameters + tokens * (8 * self.width + 2 * self.mlp))


_B, _L, _SO400M = (768, 12, 3072), (1024, 24, 4096), (1152, 27, 4304)
_HUGE, _GIANT = (1280, 32, 5120), (1536, 40, 4096)

# What the weights' name says -> sizes, per kind; the first pattern that is found counts, "" is what is taken for granted.
RELEASED: dict[str, dict[str, VitSizes]] = {
    "clip": {
        "base.?patch32|b.?32": VitSizes(*_B, 32, 512),
        "large|l.?14": VitSizes(*_L, 14, 768),
        "huge|h.?14": VitSizes(*_HUGE, 14, 1024),
        "bigg": VitSizes(1664, 48, 8192, 14, 1280),
        "": VitSizes(*_B, 16, 512),
    },
    "siglip": {
        "so400m.*16": VitSizes(*_SO400M, 16, 1152, 0),
        "so400m": VitSizes(*_SO400M, 14, 1152, 0),
        "giant": VitSizes(1536, 40, 6144, 16, 1536, 0),
        "large": VitSizes(*_L, 16, 1024, 0),
        "": VitSizes(*_B, 16, 768, 0),
    },
    "tipsv2": {
        "so400m": VitSizes(*_SO400M, 14, 1152, 2),
        "g14|giant": VitSizes(*_GIANT, 14, 1536, 2, gated=True),
        "l14|large": VitSizes(*_L, 14, 1024, 2),
        "": VitSizes(*_B, 14, 768, 2),
    },
    "dinov2": {
        "small|vits": VitSizes(384, 12, 1536, 14, 384, 5),
        "large|vitl": VitSizes(*_L, 14, 1024, 5),
        "giant|vitg": VitSizes(*_GIANT, 14, 1536, 5, gated=True),
        "": VitSizes(*_B, 14, 768, 5),
    },
    "dinov3": {
        "vits": VitSizes(384, 12, 1536, 16, 384, 5),
        "vitl": VitSizes(*_L, 16, 1024, 5),
        "vith": VitSizes(*_HUGE, 16, 1280, 5, gated=True),
        "7b": VitSizes(4096, 40, 8192, 16, 4096, 5, gated=True),
        "": VitSizes(*_B, 16, 768, 5),
    },
    "radio": {
        "so400m": VitSizes(*_SO400M, 16, 1152, 8),
        "-b|base": VitSizes(*_B, 16, 768, 8),
        "-l|large": VitSizes(*_L, 16, 1024, 8),
        "": VitSizes(*_HUGE, 16, 1280, 8),
    },
}
_TWO_TOWERS = (
    "clip",
    "openclip",
    "siglip",
    "siglip2",
    "tipsv2",
)  # with the text's, taken to be as large, in memory too
RELEASED["openclip"], RELEASED["siglip2"] = RELEASED["clip"], RELEASED["siglip"]

SAM_SIZES: dict[str, tuple[int, int, int]] = {  # width, depth, heads
    "vit_b": (768, 12, 12),
    "vit_l": (1024, 24, 16),
    "vit_h": (1280, 32, 16),
}


def known_costs() -> list[str]:
    """The teachers whose cost is known by name."""
    return list(_table())


def teacher_cost(
    name: str,
    image_size: tuple[int, int],
    *,
    weights: str | Path | None = None,
    **options: Any,
) -> TeacherCost:
    """What a picture of (height, width) pixels costs, from the sizes of the released networks; nothing is loaded.

    Args:
        name: as `load_teacher` takes it; what stands behind `package.module:name` is not known.
        image_size: (height, width) of the picture, pixels.
        weights: tells which size: a folder with config.json is read, otherwise the name decides ("...large-patch14").
            Without any, the smallest common one is taken (lseg has only one).
        options: those of the teacher that matter here: `size`; lseg: `scales`, `flip`, `fast`. Others are ignored.

    Raises:
        ValueError: if there is no such teacher, or the size is not positive.

    Example:
        >>> cost = teacher_cost("lseg", (480, 640))
        >>> cost.map_size, cost.channels, cost.forwards, round(cost.flops / 1e12, 1)
        ((360, 480), 512, 26, 20.8)
    """
    check_whole("image_size[0]", image_size[0], 1)
    check_whole("image_size[1]", image_size[1], 1)
    if ":" in name:
        return TeacherCost.unknown(name)
    table = _table()
    if name not in table:
        raise ValueError(
            f"teacher: expected one of {', '.join(table)}, or package.module:name of your own, got {name!r}; name one of them"
        )
    return table[name](name, image_size, weights, options)


def lseg_flops(config: Any) -> float:
    """Operations of LSeg's network for one window: the ViT, then a DPT decoder of four levels (`LSegConfig` has sizes)."""
    C, F, g = config.width, config.fusion, config.grid
    total = VitSizes(C, config.hooks[-1] + 1, config.mlp, config.patch, config.dim).flops(g * g)
    for level, c in enumerate(config.neck):
        side = (4 * g, 2 * g, g, g // 2)[level]
        resize = (2.0 * g**2 * c * c * 16, 2.0 * g**2 * c * c * 4, 0.0, 2.0 * side**2 * 9 * c * c)[level]
        total += 2.0 * g**2 * (2 * C * C + C * c) + resize  # readout, projection, resize
        total += 2.0 * side**2 * 9 * c * F  # to the decoder's width
        units = 4 if level < 3 else 2  # convolutions of the residual units; the coarsest level has one unit
        total += units * 2.0 * side**2 * 9 * F * F + 2.0 * (2 * side) ** 2 * F * F
    return total + 2.0 * (config.window // 2) ** 2 * F * config.dim


def _lseg(name: str, image_size: tuple[int, int], weights: str | Path | None, options: dict[str, Any]) -> TeacherCost:
    from .lseg.network import LSegConfig
    from .lseg.options import LSegOptions

    config = LSegConfig()
    chosen = LSegOptions.fast() if options.get("fast") else LSegOptions()
    given = {key: options[key] for key in ("scales", "flip", "size") if options.get(key) is not None}
    chosen = replace(chosen, **given)
    height, width = chosen.map_size(*image_size, window=config.window)
    forwards = chosen.forwards(*image_size, window=config.window)
    parameters = _lseg_parameters(config) * _FLOAT
    window = config.dim * (config.window // 2) ** 2 * _FLOAT
    result = config.dim * height * width * _FLOAT
    # Two outputs of the network and their mean, about two more of the decoder's maps, and the result with its fp16 copy.
    peak = parameters + 5 * window + result * 3 // 2
    return TeacherCost(name, config.dim, (height, width), forwards * lseg_flops(config), parameters, peak, forwards)


def _lseg_parameters(config: Any) -> int:
    C, F, neck = config.width, config.fusion, config.neck
    total = VitSizes(C, config.hooks[-1] + 1, config.mlp, config.patch, config.dim).parameters
    total += sum(2 * C * C + C * c + 9 * c * F + k * c * c for c, k in zip(neck, (16, 4, 0, 9), strict=True))
    return total + 14 * 9 * F * F + 4 * F * F + F * config.dim  # 7 residual units, 4 output convolutions, the head


def _transformer(
    name: str, image_size: tuple[int, int], weights: str | Path | None, options: dict[str, Any]
) -> TeacherCost:
    from .transformers_teacher import fit_patches

    sizes = _vit_sizes(name, weights)
    longest = options.get("size")
    if longest is not None:
        check_range("size", longest, 1)
    height, width = fit_patches(image_size, (sizes.patch, sizes.patch), longest)
    h, w = height // sizes.patch, width // sizes.patch
    parameters = sizes.parameters * _FLOAT
    text = parameters if name in _TWO_TOWERS else 0
    return TeacherCost(name, sizes.channels, (h, w), sizes.flops(h * w), parameters, sizes.peak_bytes(h * w) + text)


def _vit_sizes(kind: str, weights: str | Path | None) -> VitSizes:
    """From the config.json of a local folder, or else from the name of the weights."""
    if weights is not None and (Path(weights) / "config.json").is_file():
        return _sizes_of_config(kind, Path(weights) / "config.json")
    named = str(weights or "").lower().replace("_", "-")
    return next(sizes for pattern, sizes in RELEASED[kind].items() if re.search(pattern, named))


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


def sam_flops(width: int, depth: int, heads: int) -> float:
    """Operations of SAM's image encoder at 1024 x 1024: blocks of 14 x 14 windows (padded), and four that see everything."""
    side = _SAM_PIXELS // _SAM_PATCH  # 64
    windows = (-(-side // _SAM_WINDOW)) ** 2  # 25
    total = 2.0 * side**2 * 3 * _SAM_PATCH**2 * width
    for count, areas, cells in ((depth - _SAM_GLOBAL, windows, _SAM_WINDOW), (_SAM_GLOBAL, 1, side)):
        n = cells * cells
        # Projections, similarities and sums, and the relative positions of rows and of columns.
        attention = areas * (8.0 * n * width**2 + 4.0 * n**2 * width + 2 * 2.0 * n * cells * width)
        total += count * (attention + 2.0 * side**2 * 8 * width**2)
    return total + 2.0 * side**2 * (_SAM_CHANNELS * width + 9 * _SAM_CHANNELS**2)


def _sam(name: str, image_size: tuple[int, int], weights: str | Path | None, options: dict[str, Any]) -> TeacherCost:
    side = _SAM_PIXELS // _SAM_PATCH
    scale = side / max(image_size)
    h, w = (max(1, min(side, int(length * scale + 0.5))) for length in image_size)
    named = str(weights or "").lower().replace("-", "_")
    if "mobile" in named:  # another network, of which only the map is known
        return TeacherCost(name, _SAM_CHANNELS, (h, w), None, None, None)
    width, depth, heads = next((sizes for kind, sizes in SAM_SIZES.items() if kind in named), SAM_SIZES["vit_b"])
    blocks = depth * 12 * width**2 + 3 * _SAM_PATCH**2 * width
    parameters = (blocks + _SAM_CHANNELS * (width + 9 * _SAM_CHANNELS)) * _FLOAT
    attention = side**4 * heads * _FLOAT  # similarities of all pairs; three such arrays while positions are added
    peak = parameters + 3 * attention + 12 * side**2 * width * _FLOAT
    return TeacherCost(name, _SAM_CHANNELS, (h, w), sam_flops(width, depth, heads), parameters, peak)


def _table() -> dict[str, Callable[[str, tuple[int, int], str | Path | None, dict[str, Any]], TeacherCost]]:
    return {"lseg": _lseg, **dict.fromkeys(RELEASED, _transformer), "sam": _sam}
