"""What a teacher costs per picture, known before it is loaded: size of its map, operations, memory.

Operations are counted as FlopCounterMode of torch does: two per multiply-add of a product or convolution, nothing else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from .._check import check_range, check_whole
from .vit_sizes import FLOAT, RELEASED, SAM_SIZES, VitSizes, last_name, sam_sizes, vit_sizes

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
    assumed: str | None = None
    """Which size was assumed, in words; None where the config or the name of the weights says the size."""

    @classmethod
    def unknown(cls, name: str) -> TeacherCost:
        """A teacher about which nothing is known."""
        return cls(name, None, None, None, None, None)

    @classmethod
    def of_maps(cls, name: str, shape: tuple[int, int, int]) -> TeacherCost:
        """Maps (h, w, D) that exist already: the teacher has nothing to do."""
        h, w, channels = shape
        return cls(name, channels, (h, w), 0.0, 0, 0, 0)


# In memory with their text tower, assumed to be as large as the image tower.
_TWO_TOWERS = ("clip", "openclip", "siglip", "siglip2", "tipsv2")


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
        name: as in `load_teacher`. The cost of `package.module:name` is unknown.
        image_size: (height, width) of the picture, pixels.
        weights: decides the size, by config.json if it is a folder that has one, otherwise by the last part of its name
            ("...large-patch14"). If the name has no size, a common one is used, and `assumed` says which (lseg has only
            one).
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


def check_weights(name: str, weights: str | Path | None) -> None:
    """Refuse weights that `load_teacher` would refuse at once. Only config.json is read.

    Hub ids and the weights of your own teachers are not checked.

    Raises:
        FileNotFoundError: if the checkpoint (lseg, sam) is not there, or the folder lacks its config.json.
        ValueError: if the config is of another model.
    """
    if weights is None:
        return
    if name in RELEASED:
        from .transformers_openclip import find_openclip
        from .transformers_source import find_source, read_config
        from .transformers_table import TRANSFORMERS

        source, takes_openclip = find_source(name, weights), TRANSFORMERS[name].activation is not None
        if isinstance(source, Path) and not (takes_openclip and find_openclip(name, source, local_only=True)):
            read_config(name, source, local_only=True)
    elif name in ("lseg", "sam"):
        path, sizes = Path(weights).expanduser(), SAM_SIZES if name == "sam" else {}
        if not path.is_file() and str(weights) not in sizes:
            other = f", or one of {', '.join(sizes)} to plan for" if sizes else ""
            raise FileNotFoundError(
                f"{weights}: expected a checkpoint file of teacher {name!r}{other}, got "
                f"{'a folder' if path.is_dir() else 'no such file'}; check its name, or leave --weights out to plan without"
            )


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
    parameters = _lseg_parameters(config) * FLOAT
    window = config.dim * (config.window // 2) ** 2 * FLOAT
    result = config.dim * height * width * FLOAT
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

    sizes, guessed = vit_sizes(name, weights)
    longest = options.get("size")
    if longest is not None:
        check_range("size", longest, 1)
    height, width = fit_patches(image_size, (sizes.patch, sizes.patch), longest)
    h, w = height // sizes.patch, width // sizes.patch
    parameters = sizes.parameters * FLOAT
    peak = sizes.peak_bytes(h * w) + (parameters if name in _TWO_TOWERS else 0)
    assumed = _assumed(weights, f"{sizes.depth} blocks of {sizes.width} channels, patches of {sizes.patch}")
    return TeacherCost(
        name,
        sizes.channels,
        (h, w),
        sizes.flops(h * w),
        parameters,
        peak,
        assumed=assumed if guessed else None,
    )


def _assumed(weights: str | Path | None, sizes: str) -> str:
    reason = "no weights are named" if weights is None else f"{last_name(weights)!r} tells no size"
    return f"{sizes}, since {reason}"


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
    if "mobile" in last_name(weights).lower():  # another network, of which only the map is known
        return TeacherCost(name, _SAM_CHANNELS, (h, w), None, None, None)
    (width, depth, heads), guessed = sam_sizes(weights)
    blocks = depth * 12 * width**2 + 3 * _SAM_PATCH**2 * width
    parameters = (blocks + _SAM_CHANNELS * (width + 9 * _SAM_CHANNELS)) * FLOAT
    attention = side**4 * heads * FLOAT  # similarities of all pairs; three such arrays while positions are added
    peak = parameters + 3 * attention + 12 * side**2 * width * FLOAT
    assumed = _assumed(weights, f"{depth} blocks of {width} channels") if guessed else None
    flops = sam_flops(width, depth, heads)
    return TeacherCost(name, _SAM_CHANNELS, (h, w), flops, parameters, peak, assumed=assumed)


def _table() -> dict[str, Callable[[str, tuple[int, int], str | Path | None, dict[str, Any]], TeacherCost]]:
    return {"lseg": _lseg, **dict.fromkeys(RELEASED, _transformer), "sam": _sam}
