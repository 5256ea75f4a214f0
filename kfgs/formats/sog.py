"""PlayCanvas' SOG scenes (Spatially Ordered Gaussians): a zip file or a folder of `meta.json` and lossless images.

Each Gaussian is one pixel, row by row. `means_l`, `means_u`: low and high byte of 16 bits between the bounds of
sign(x) ln(1 + |x|). `quats`: three smaller components in 8 bits each, 252 + the index of the largest (w, x, y, z) as
alpha. `scales`: indices into a codebook of natural logarithms. `sh0`: indices into a codebook of base colours, opacity
as alpha. `shN_labels`: which row of `shN_centroids`, 64 to a line, holds the higher harmonics, as indices into a third
codebook. Version 1 has even steps between bounds instead of codebooks, and opacity as a logit; it is read, not written.
Axes are those of the 3DGS PLY. The format cannot store labels, so they go to a separate file.

**Why not a library**: gsply 0.4.6 reads SOG but does not write it, and unpacks a zip entry to any size it claims. The tests
use it as an independent reader.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .._files import atomic_folder, atomic_path
from .._notes import tell
from ..gaussians import Gaussians
from .order import morton_order
from .palette import Palette, fit_codebook, fit_palette, nearest_codes
from .render_mode import meta_of_mode, with_mode
from .sidecar import read_sidecar
from .smallest_three import pack_smallest_three, rotation_error, unpack_smallest_three
from .sog_images import META, SogFiles, encode_image, write_zip
from .sog_meta import SogMeta, parse_meta
from .values import NO_DEGREE_4, Precision, colours_to_write, describe_coarse, describe_loss, positive_scales

NAME = "sog"
SUFFIXES = (".sog",)
MAGIC = b"PK\x03\x04"
HOLDS_LABELS = False
SORTS = True
_LARGEST_FIRST = 252  # alpha of a rotation whose largest component is w
_PER_LINE = 64  # rows of the palette in a line of its image
_LEVELS = 65535
REST_FILES = ("shN_centroids.webp", "shN_labels.webp")


class _Rest(NamedTuple):
    """The higher harmonics as they are stored."""

    palette: Palette  # rows [P, (K - 1) * 3]
    codebook: NDArray[np.float32]  # [256]
    codes: NDArray[np.uint8]  # [P, (K - 1) * 3]


def matches(head: bytes) -> bool:
    """A zip file (no other format here is one), or a `meta.json` that names means and rotations."""
    return head.startswith(MAGIC) or (head.lstrip()[:1] == b"{" and b'"means"' in head and b'"quats"' in head)


def read(path: Path) -> Gaussians:
    """Read a .sog file, a folder with `meta.json`, or that `meta.json`; opacities of 0 and 1 stay 0 and 1.

    Raises:
        ValueError: if it is neither, a file is missing or damaged, or sizes and indices disagree.
    """
    with SogFiles(path) as files:
        meta = parse_meta(path, files.read_meta(), files.size())
        n = meta.gaussians
        low, high = (_pixels(files, name, n)[:, :3].astype(np.float64) for name in meta.files["means"])
        scales = _pixels(files, meta.files["scales"][0], n)
        rgba = _pixels(files, meta.files["sh0"][0], n)
        quats = _read_rotations(files, meta)
        sh = np.concatenate([_look_up(meta.tables["sh0"], rgba[:, :3])[:, None], _read_rest(files, meta)], 1)
    bounds = np.array(meta.bounds)  # [2, 3]
    logs = bounds[0] + (bounds[1] - bounds[0]) * ((low + 256 * high) / _LEVELS)
    with np.errstate(over="ignore", invalid="ignore"):  # left out
        means = np.sign(logs) * np.expm1(np.abs(logs))
        linear = np.exp(_look_up(meta.tables["scales"], scales[:, :3]))
    gaussians = Gaussians(
        means=torch.from_numpy(means),
        quats=quats,
        scales=positive_scales(path, linear),
        opacities=_opacities(meta, rgba[:, 3]),
        sh=torch.from_numpy(sh[:, :16]),
    )
    if sh.shape[1] > 16:
        tell(f"{path.name}: {NO_DEGREE_4}")
    gaussians = with_mode(path, gaussians, meta.mode)
    return read_sidecar(path.parent, gaussians) if path.name == META else gaussians  # labels are next to the folder


def write(path: Path, gaussians: Gaussians) -> tuple[str, ...]:
    """Write version 2 in the given order: a zip file if the name ends in .sog, else a folder.

    Raises:
        ValueError: if the cloud has no colours, or there is a folder of that name with files that do not belong to a SOG scene.
    """
    g = colours_to_write(gaussians, ".sog")
    files = _encode(g, meta_of_mode(gaussians))
    if path.name.lower().endswith(SUFFIXES):
        with atomic_path(path) as temporary:
            write_zip(temporary, files)
    else:
        _check_folder(path)
        with atomic_folder(path) as folder:
            for name, data in files.items():
                (folder / name).write_bytes(data)
        for name in set(REST_FILES) - set(files):  # of an older scene with more harmonics
            (path / name).unlink(missing_ok=True)
    return describe_loss(gaussians, ".sog", 3) + describe_coarse(g, _errors(g.means.numpy()), ".sog")


def precision(gaussians: Gaussians) -> Precision:
    """The errors with this cloud's codebooks and palette; `means` is [N, 3] in the order of `gaussians`.

    Takes as long as writing, because codebooks and palette are fitted.
    """
    g = colours_to_write(gaussians, ".sog").select(morton_order(gaussians.means).cpu())
    assert g.sh is not None
    rest = _fit_rest(g.sh)
    return Precision(
        means=_errors(gaussians.means.detach().cpu().double().numpy()),
        scales=math.expm1(_code_error(g.scales.log().numpy())) + 1e-5,
        rotation=rotation_error(255),
        opacities=0.5 / 255 + 1e-6,
        sh0=_code_error(g.sh[:, 0].numpy()) + 1e-6,
        sh_rest=_rest_error(g.sh, rest) + 1e-6,
    )


# Reading


def _pixels(files: SogFiles, name: str, count: int) -> NDArray[np.uint8]:  # [count, 4]
    return files.read_image(name, count).reshape(-1, 4)[:count]


def _look_up(table: NDArray[np.float32], codes: NDArray[np.uint8]) -> NDArray[np.float32]:  # [3, 256], [..., 3]
    return np.stack([table[channel][codes[..., channel]] for channel in range(3)], -1)


def _opacities(meta: SogMeta, alpha: NDArray[np.uint8]) -> Tensor:  # [N]
    if meta.logits is None:
        return torch.from_numpy(alpha.astype(np.float32) / 255)
    low, high = meta.logits
    return torch.from_numpy((low + (high - low) * (alpha / 255.0)).astype(np.float32)).sigmoid()


def _read_rotations(files: SogFiles, meta: SogMeta) -> Tensor:  # [N, 4] wxyz
    pixels = _pixels(files, meta.files["quats"][0], meta.gaussians)
    if (pixels[:, 3] < _LARGEST_FIRST).any():
        row = int((pixels[:, 3] < _LARGEST_FIRST).argmax())
        raise ValueError(
            f"{files.path}: expected rotations whose alpha is 252 to 255, got {pixels[row, 3]} at Gaussian {row}; was the "
            "image saved with loss? export it again"
        )
    largest = pixels[:, 3].astype(np.int64) - _LARGEST_FIRST
    return unpack_smallest_three(largest, pixels[:, :3].astype(np.float32), 255)


def _read_rest(files: SogFiles, meta: SogMeta) -> NDArray[np.float32]:  # [N, K - 1, 3]
    if "shN" not in meta.files:
        return np.zeros((meta.gaussians, 0, 3), np.float32)
    names = meta.files["shN"]
    labels = _pixels(files, names[1], meta.gaussians)[:, :2].astype(np.int64) @ np.array([1, 256])
    size = int(labels.max(initial=-1)) + 1 if meta.palette is None else meta.palette
    lines = -(-size // _PER_LINE)
    widths = {1: 3 * _PER_LINE, 2: 8 * _PER_LINE, 3: 15 * _PER_LINE, 4: 24 * _PER_LINE}
    image = files.read_image(names[0], lines * widths[meta.degree or 1], max(lines, 1024) * widths[4])[:, :, :3]
    expected = [widths[meta.degree]] if meta.degree else list(widths.values())
    if image.shape[1] not in expected or len(image) < lines:
        raise ValueError(
            f"{files.path}: expected {names[0]!r} of {' or '.join(map(str, expected))} x {lines} pixels, got "
            f"{image.shape[1]} x {image.shape[0]}; export it again"
        )
    if len(labels) and labels.max() >= size:
        raise ValueError(
            f"{files.path}: expected labels below {size} in {names[1]!r}, got {labels.max()}; export it again"
        )
    codes = image.reshape(-1, image.shape[1] // _PER_LINE, 3)[labels]
    return _look_up(meta.tables["shN"], codes)


# Writing


def _log_positions(means: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.sign(means) * np.log1p(np.abs(means))


def _errors(means: NDArray[np.float64]) -> Tensor:  # [N, 3] -> [N, 3]
    """The largest errors of positions: half a step of the logarithm."""
    logs = _log_positions(means)
    half_step = (logs.max(0) - logs.min(0)) / _LEVELS / 2 if len(means) else np.zeros(3)
    size = np.exp(np.abs(logs))
    return torch.from_numpy(size * np.expm1(half_step) * (1 + 1e-6) + size * 2.0**-23)


def _encode(g: Gaussians, mode: dict[str, Any]) -> dict[str, bytes]:
    """The files of a scene; `mode` goes into `meta.json`."""
    assert g.sh is not None
    logs = _log_positions(g.means.numpy())
    low, high = (logs.min(0), logs.max(0)) if len(g) else (np.zeros(3), np.zeros(3))
    levels = np.round((logs - low) / np.where(high > low, high - low, 1.0) * _LEVELS).astype(np.int64)
    largest, small = pack_smallest_three(g.quats, 255)
    scales, sh0 = g.scales.log().numpy(), g.sh[:, 0].numpy()
    books = {"scales": fit_codebook(scales), "sh0": fit_codebook(sh0)}
    opacity = np.round(np.clip(g.opacities.numpy(), 0, 1) * 255)[:, None]
    images = {
        "means_l.webp": levels & 255,
        "means_u.webp": levels >> 8,
        "quats.webp": np.concatenate([small, largest + _LARGEST_FIRST], 1),
        "scales.webp": nearest_codes(books["scales"], scales),
        "sh0.webp": np.concatenate([nearest_codes(books["sh0"], sh0), opacity], 1),
    }
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "kfgs"},
        "count": len(g),
        **mode,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": books["scales"].tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": books["sh0"].tolist(), "files": ["sh0.webp"]},
    }
    rest = _fit_rest(g.sh)
    if rest is not None:
        names = list(REST_FILES)
        images |= dict(zip(names, _rest_images(rest), strict=True))
        degree = {9: 1, 24: 2, 45: 3}[rest.codes.shape[1]]
        book = rest.codebook.tolist()
        meta["shN"] = {"count": len(rest.codes), "bands": degree, "codebook": book, "files": names}
    encoded = {name: encode_image(pixels.astype(np.uint8)) for name, pixels in images.items()}
    return {META: json.dumps(meta, allow_nan=False).encode(), **encoded}


def _fit_rest(sh: Tensor) -> _Rest | None:  # [N, K, 3]
    """A palette of the higher harmonics: 1,024 rows, doubled up to 65,536 for more Gaussians."""
    if sh.shape[1] == 1 or not len(sh):
        return None
    size = 1024 * min(64, 2 ** int(math.log2(max(len(sh), 1024) / 1024)))
    palette = fit_palette(sh[:, 1:].flatten(1).float(), size)
    rows = palette.rows.double().numpy()
    codebook = fit_codebook(rows)
    return _Rest(palette, codebook, nearest_codes(codebook, rows))


def _rest_images(rest: _Rest) -> tuple[NDArray[Any], NDArray[Any]]:
    """The palette, 64 rows to a line, and each Gaussian's row in two bytes."""
    lines = -(-len(rest.codes) // _PER_LINE)
    padded = np.zeros((lines * _PER_LINE, rest.codes.shape[1]), np.uint8)
    padded[: len(rest.codes)] = rest.codes
    labels = rest.palette.labels.numpy()
    return padded.reshape(lines, -1, 3), np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], 1)


def _code_error(values: NDArray[np.float64]) -> float:
    book = fit_codebook(values)
    return float(np.abs(book[nearest_codes(book, values)] - values).max(initial=0.0))


def _rest_error(sh: Tensor, rest: _Rest | None) -> float:
    if rest is None:
        return 0.0
    stored = torch.from_numpy(rest.codebook[rest.codes])[rest.palette.labels]
    return float((stored - sh[:, 1:].flatten(1)).abs().max())


def _check_folder(path: Path) -> None:
    """Raise unless a folder holds only a scene, whose files are replaced."""
    if not path.exists():
        return
    others = [] if path.is_dir() else [path.name]
    if path.is_dir():
        others = [file.name for file in path.iterdir() if file.name != META and file.suffix != ".webp"]
    if others or path.name == META:
        raise ValueError(
            f"path: expected a new folder, or one with a SOG scene alone, got {path} with {', '.join(others[:3])}; choose "
            "another name, or one that ends in .sog"
        )
