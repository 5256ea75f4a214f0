"""A semantic field in one file: a .safetensors file of compressed streams, one per tensor, and one that describes them.

The header's metadata says what the file is. The stream "description" is JSON: what `to_tensors` says of the field, and of each
tensor its coding, shape, error and checksum. docs/formats.md has the layout.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from typing import Any, NoReturn

import numpy as np
import safetensors.torch
import torch
import zstandard
from safetensors import SafetensorError
from torch import Tensor

from .._arrays import most_unpacked
from .._files import parse_json
from ..formats.order import morton_codes
from ..formats.values import unit_quats
from .coding import (
    CELLS,
    DTYPES,
    QR_MOST,
    Array,
    Coded,
    Entry,
    Place,
    decode,
    encode_exact,
    encode_logs,
    encode_means,
    encode_near,
    encode_rows,
    encode_steps,
    encode_turns,
    plain_size,
    qr_work,
)
from .precision import CUSTOM, PRECISIONS, Rounding
from .turns import nearest_turn

KIND, VERSION = "semantic field", 1
ABOUT = "description"
LEVEL = 19  # of zstd: the best compression that takes only seconds
HEADER, WORDS = 1 << 20, 8 << 20
"""Most bytes of a header, and of the description."""
EDGE = 1e-4
"""Unpacked opacities keep this distance from 0 and 1, as everywhere in kfgs."""
HUGE = 1e37
"""Largest number that is rounded: a step away from it, float32 does not overflow yet."""


def pack_tensors(tensors: dict[str, Tensor], description: dict[str, Any], precision: str | Rounding) -> bytes:
    """The file of a field, given what `to_tensors` made of it.

    Raises:
        ValueError: if no reader would take the file: a number is not finite, or too large to be rounded; an opacity lies outside
            [0, 1]; a scale is negative; a tensor has an unknown type; or the description is too large.
    """
    kept = {name: value.detach().cpu() for name, value in tensors.items()}
    for name, value in kept.items():
        _check_values(name, value)
    chosen, precision = (PRECISIONS[precision], precision) if isinstance(precision, str) else (precision, CUSTOM)
    coded = {name: encode_exact(value) for name, value in kept.items()} if chosen is None else _round(kept, chosen)
    shapes = {name: list(value.shape) for name, value in kept.items()}
    streams = {name: _compress(one.plain) for name, one in coded.items()}
    if sum(_unpacked(one.entry, shapes[name]) for name, one in coded.items()) > _most(streams):
        streams = {name: one.plain for name, one in coded.items()}
    entries = {
        name: {**one.entry, "shape": shapes[name], "crc32": zlib.crc32(one.plain)} for name, one in coded.items()
    }
    errors = {name: one.entry["error"] for name, one in coded.items() if one.entry["error"]}
    if errors:
        before = description["info"].get("rounded")
        history = [*(before if isinstance(before, list) else []), {"precision": precision, "errors": errors}]
        description = {**description, "info": {**description["info"], "rounded": history}}
    words = json.dumps({**description, "precision": precision, "tensors": entries}, allow_nan=False).encode()
    if len(words) > WORDS:
        raise ValueError(
            f"info: expected at most {WORDS} bytes of JSON with names of views, got {len(words)}; shorten it"
        )
    about = json.dumps(
        {"kind": KIND, "version": VERSION, "precision": precision, "gaussians": description["gaussians"]}
    )
    streams[ABOUT] = zstandard.ZstdCompressor(level=LEVEL, write_checksum=True).compress(words)
    whole = {name: torch.from_numpy(np.frombuffer(data, np.uint8).copy()) for name, data in streams.items()}
    return bytes(safetensors.torch.save(whole, metadata={"kfgs": about}))  # one key: several have no fixed order


def unpack_tensors(data: bytes, name: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors and the description that `pack_tensors` was given. Sizes are checked before memory is taken.

    Raises:
        ValueError: if it is no packed field, is damaged, or promises more than it can hold; the message begins with `name`.
    """
    about = peek(data[: HEADER + 8])
    if about is None:
        raise ValueError(
            f"{name}: expected a kfgs {KIND} in one file, got something else; pass what SemanticField.save or `kfgs pack` "
            "wrote"
        )
    if about.get("version") != VERSION:
        raise ValueError(
            f"{name}: expected format version {VERSION}, got {about.get('version')!r:.40}; use the kfgs that wrote it"
        )
    try:
        with np.errstate(all="ignore"):  # what overflows is not finite, and refused
            return _unpack(data)
    except (
        SafetensorError,
        zstandard.ZstdError,
        ArithmeticError,
        AttributeError,
        LookupError,
        RuntimeError,
        TypeError,
        ValueError,
    ) as error:
        what = f"{type(error).__name__}: {error}" if isinstance(error, LookupError) else str(error)
        raise ValueError(
            f"{name}: expected a field as it was packed, but it is damaged ({what:.300}); copy it again, or pack the field "
            "again"
        ) from error


def peek(head: bytes) -> dict[str, Any] | None:
    """What the header of a file says: kind, version, precision, number of Gaussians. None if it is no packed field."""
    if len(head) < 8:
        return None
    (length,) = struct.unpack("<Q", head[:8])
    if not 2 <= length <= min(HEADER, len(head) - 8):
        return None
    try:
        about = parse_json(parse_json(head[8 : 8 + length])["__metadata__"]["kfgs"])
        return dict(about) if about["kind"] == KIND else None
    except (ValueError, LookupError, TypeError):
        return None


def stream_sizes(data: bytes) -> dict[str, int]:
    """The compressed bytes of each tensor of a packed field, largest first."""
    sizes = {name: value.numel() for name, value in safetensors.torch.load(data).items()}
    return dict(sorted(sizes.items(), key=lambda one: -one[1]))


def _round(tensors: dict[str, Tensor], chosen: Rounding) -> dict[str, Coded]:
    """Every tensor in whole steps; the Gaussians in the order of their cells."""
    arrays = {name: value.double().numpy() for name, value in tensors.items() if value.is_floating_point()}
    means, scales = arrays["gaussians.means"], arrays["gaussians.scales"]
    for name, array in arrays.items():
        if np.abs(array).max(initial=0) > HUGE:
            raise ValueError(f"{name}: expected numbers up to {HUGE:g} to round, got larger ones; pack without loss")
    N, radius = len(means), np.median(np.sort(scales, axis=1)[:, 1:]) if len(means) else 1.0
    extent = float(np.ptp(means, axis=0).max()) if N else 0.0
    step = max(2 * chosen.means * float(radius), extent / CELLS) or 1.0
    order = _cell_order(means, step)
    arrays["gaussians.quats"], arrays["gaussians.scales"] = nearest_turn(
        unit_quats(torch.from_numpy(arrays["gaussians.quats"])).numpy(), scales
    )
    per_gaussian = ("gaussians.", "answers.", "seen.")
    tensors = {name: value[order] if name.startswith(per_gaussian) else value for name, value in tensors.items()}
    arrays = {name: value[order] if name.startswith(per_gaussian) else value for name, value in arrays.items()}
    first, place = encode_means(arrays["gaussians.means"], step)
    fused = "linear.basis" in arrays and "answers.latents" not in arrays
    coded = {"gaussians.means": first}
    for name, value in tensors.items():
        if name != "gaussians.means":
            coded[name] = _round_one(name, value, arrays.get(name), chosen, place, step, fused)
    return coded


def _round_one(
    name: str, value: Tensor, array: Array | None, chosen: Rounding, place: Place, step: float, fused: bool
) -> Coded:
    """One tensor other than the means. What has no coding here (labels, cameras, biases) stays exact."""
    if array is None or not array.size:
        return encode_exact(value)
    match name.split("."):
        case ["gaussians", "quats"]:
            return encode_turns(array, chosen.degrees)
        case ["gaussians", "scales"]:
            return encode_logs(array, chosen.scales, step)
        case ["gaussians", "opacities"] | ["seen", "agreement"]:
            return encode_steps(array, 2 * chosen.opacities)
        case ["gaussians", "features"]:
            return encode_near(array, chosen.latents if fused else chosen.latents / 2, place)
        case ["answers", "latents"]:
            return encode_near(array, chosen.latents, place)
        case ["seen", "pixels"]:
            return encode_logs(array, chosen.pixels, 1.0)
        case ["linear", "basis"] if qr_work(value.shape) <= QR_MOST:
            return encode_rows(array, chosen.decoder, "basis")
        case ["codebook", "codewords"] | ["words", _]:
            return encode_rows(array, chosen.decoder)
        case ["autoencoder", _, _, "weight"]:
            return encode_rows(array, chosen.decoder / 4)
    return encode_exact(value)


def _cell_order(means: Array, step: float) -> Array:  # [N]
    """Sort by the Morton codes of the steps, which `encode_means` needs; Gaussians of one cell keep their order."""
    if not len(means):
        return np.zeros(0, np.int64)
    cells = np.round((means - means.min(0)) / step).astype(np.uint64)
    return np.argsort(morton_codes(cells), kind="stable")


def _unpack(data: bytes) -> tuple[dict[str, Tensor], dict[str, Any]]:
    streams = safetensors.torch.load(data)  # checks the header; streams are copies of what is in the file
    for name, stream in streams.items():
        if stream.dtype != torch.uint8 or stream.ndim != 1:
            raise ValueError(f"{name}: expected a stream of bytes, got {stream.dtype} {tuple(stream.shape)}")
    packed = {name: stream.numpy().tobytes() for name, stream in streams.items()}
    description = parse_json(
        _decompress(packed.pop(ABOUT), None, WORDS), parse_constant=_no_constant, parse_float=_finite
    )
    entries = description.pop("tensors")
    description.pop("precision")
    if set(entries) != set(packed):
        raise ValueError(f"expected a description of {sorted(packed)}, got {sorted(entries)!r:.200}")
    shapes = {name: _checked_shape(entry["shape"]) for name, entry in entries.items()}
    plain = {name: plain_size(entry, shapes[name]) for name, entry in entries.items()}
    total = sum(max(plain[name], _unpacked(entry, shapes[name])) for name, entry in entries.items())
    if total > _most(packed):
        raise ValueError(
            f"it would unpack to {total} bytes, of {len(data)}; a packed field has at most {_most(packed)}"
        )
    tensors: dict[str, Tensor] = {}
    place: Place | None = None
    for name in sorted(entries, key=lambda one: entries[one]["coding"] != "curve"):  # others may need the means
        content = _decompress(packed[name], plain[name], plain[name])
        if zlib.crc32(content) != entries[name]["crc32"]:
            raise ValueError(f"{name}: expected other bytes, by its checksum")
        value, place = decode(entries[name], shapes[name], content, place)
        tensors[name] = _bounded(name, value, entries[name])
        _check_values(name, tensors[name])
    return tensors, description


def _bounded(name: str, value: Tensor, entry: Entry) -> Tensor:
    """Rounded opacities inside (0, 1), and rounded scales above 0."""
    if entry["coding"] != "exact":
        array = _plain(value)
        if name == "gaussians.opacities":
            np.clip(array, EDGE, 1 - EDGE, out=array)
        if name == "gaussians.scales":
            np.maximum(array, float(entry["error"]) * float(entry["least"]) / 2, out=array)
    return value


def _compress(plain: bytes) -> bytes:
    """Compress bytes; return them unchanged if that does not make them shorter."""
    packed = zstandard.ZstdCompressor(level=LEVEL).compress(plain)
    return packed if len(packed) < len(plain) else plain


def _decompress(stream: bytes, size: int | None, most: int) -> bytes:
    """The inverse of `_compress`: a stream of `size` bytes is not compressed. A ValueError for more than `most` bytes."""
    if size is not None and len(stream) == size:
        return stream
    found = zstandard.get_frame_parameters(stream).content_size
    if found > most or (size is not None and found != size):
        raise ValueError(f"a stream would unpack to {found} bytes; expected {most if size is None else size}")
    return zstandard.ZstdDecompressor().decompress(stream, max_output_size=most)


def _unpacked(entry: Entry, shape: tuple[int, ...] | list[int]) -> int:
    """Bytes of a tensor in memory."""
    return 8 * math.prod(shape) if entry["coding"] == "exact" else 4 * math.prod(shape)


def _most(streams: dict[str, bytes]) -> int:
    """The most bytes that these streams may unpack to. A cloud that compresses better is stored uncompressed."""
    return most_unpacked(sum(len(stream) for name, stream in streams.items() if name != ABOUT))


def _checked_shape(shape: Any) -> tuple[int, ...]:
    if (
        not isinstance(shape, list)
        or len(shape) > 3
        or not all(type(one) is int and 0 <= one < 1 << 40 for one in shape)
    ):
        raise ValueError(f"shape: expected at most three whole numbers, got {shape!r:.80}")
    return tuple(shape)


def _check_values(name: str, value: Tensor) -> None:
    """A ValueError for values that no field has. What is refused here when a file is read is not written either."""
    if value.dtype not in DTYPES.values():
        raise ValueError(
            f"{name}: expected one of {', '.join(DTYPES)}, got {value.dtype}; convert it with .long() or .float()"
        )
    if value.is_floating_point() and not np.isfinite(_plain(value)).all():
        raise ValueError(f"{name}: expected finite numbers, got NaN or infinity; fit the field again")
    most = {"gaussians.opacities": 1.0, "gaussians.scales": math.inf}.get(name)
    if most is not None and value.numel():
        low, high = float(_plain(value).min()), float(_plain(value).max())
        if not 0 <= low <= high <= most:
            raise ValueError(
                f"{name}: expected numbers from 0 to {most:g}, got {low if low < 0 else high:g}; clamp them, or fit the field "
                "again"
            )


def _plain(value: Tensor) -> Array:
    """A tensor for NumPy's checks. Those of torch wake all threads, which takes longer than the work if others use the cores."""
    return value.float().numpy() if value.dtype == torch.bfloat16 else value.numpy()


def _finite(word: str) -> float:
    return float(word) if math.isfinite(float(word)) else _no_constant(word)


def _no_constant(word: str) -> NoReturn:
    raise ValueError(f"expected finite numbers in JSON, got {word}")
