"""PlayCanvas' SOG scenes (Spatially Ordered Gaussians): a zip file or a folder of `meta.json` and lossless images.

Each Gaussian is one pixel, row by row. `means_l`, `means_u`: low and high byte of 16 bits between the bounds of
sign(x) ln(1 + |x|). `quats`: three smaller components in 8 bits each, 252 + the index of the largest (w, x, y, z) as
alpha. `scales`: indices into a codebook of natural logarithms. `sh0`: indices into a codebook of base colours, opacity
as alpha. `shN_labels`: which row of `shN_centroids`, 64 to a line, holds the higher harmonics, as indices into a third
codebook. Axes are those of the 3DGS PLY. The format cannot store labels, so they go to a separate file.

**Why not a library**: gsply 0.4.6 reads SOG but does not write it, and unpacks a zip entry to any size it claims.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from .._files import atomic_path
from ..gaussians import Gaussians
from .encodings import fit_codebook, fit_palette, nearest_codes, pack_smallest_three, unpack_smallest_three
from .render_mode import with_mode
from .sog_files import META, SogFiles, SogMeta, open_scene
from .values import describe_coarse, positive_scales, up_to_degree_3

NAME = "sog"
SUFFIXES = (".sog",)
MAGIC = b"PK\x03\x04"
HOLDS = frozenset({"harmonics", "antialiased"})
SORTS = True
_LARGEST_FIRST = 252  # alpha of a rotation whose largest component is w
_PER_LINE = 64  # rows of the palette in a line of its image
_LEVELS = 65535
_EPOCH = (1980, 1, 1, 0, 0, 0)  # a fixed date, so that equal scenes give equal files


def matches(head: bytes) -> bool:
    """A zip file (no other format here is one)."""
    return head.startswith(MAGIC)


def read(path: Path) -> Gaussians:
    """Read a .sog file, or a folder with `meta.json`; opacities of 0 and 1 stay 0 and 1."""
    with open_scene(path) as files:
        meta = files.read_meta()
        n = meta.size
        low, high = (_pixels(files, name, n)[:, :3].astype(np.float64) for name in meta.files["means"])
        scales = _pixels(files, meta.files["scales"][0], n)
        rgba = _pixels(files, meta.files["sh0"][0], n)
        turns = _pixels(files, meta.files["quats"][0], n)
        sh = np.concatenate([meta.tables["sh0"][rgba[:, :3]][:, None], _read_rest(files, meta)], 1)
    if (turns[:, 3] < _LARGEST_FIRST).any():
        row = int((turns[:, 3] < _LARGEST_FIRST).argmax())
        raise ValueError(f"the rotation of Gaussian {row} has alpha {turns[row, 3]}, not 252 to 255: a lossy image?")
    largest = turns[:, 3].astype(np.int64) - _LARGEST_FIRST
    logs = meta.bounds[0] + (meta.bounds[1] - meta.bounds[0]) * ((low + 256 * high) / _LEVELS)
    with np.errstate(over="ignore", invalid="ignore"):  # left out
        means = np.sign(logs) * np.expm1(np.abs(logs))
        linear = np.exp(meta.tables["scales"][scales[:, :3]])
    gaussians = Gaussians(
        means=torch.from_numpy(means),
        quats=unpack_smallest_three(largest, turns[:, :3].astype(np.float32), 255),
        scales=positive_scales(linear),
        opacities=torch.from_numpy(rgba[:, 3].astype(np.float32) / 255),
        sh=up_to_degree_3(path, torch.from_numpy(sh)),
    )
    return with_mode(path, gaussians, meta.mode)


def write(path: Path, g: Gaussians) -> list[str]:
    """Write version 2 in the given order, as a zip file without compression (its images have it) and without dates."""
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
        for name, data in _encode(g).items():
            archive.writestr(zipfile.ZipInfo(name, _EPOCH), data)
    return describe_coarse(g, position_errors(g.means.numpy()), ".sog")


def position_errors(means: NDArray[np.float64]) -> Tensor:  # [N, 3] -> [N, 3]
    """The largest errors of positions, in world units: half a step of the logarithm."""
    logs = _log_positions(means)
    half_step = (logs.max(0) - logs.min(0)) / _LEVELS / 2 if len(means) else np.zeros(3)
    size = np.exp(np.abs(logs))
    return torch.from_numpy(size * np.expm1(half_step) * (1 + 1e-6) + size * 2.0**-23)


def _pixels(files: SogFiles, name: str, count: int) -> NDArray[np.uint8]:  # [count, 4]
    return files.read_image(name, count).reshape(-1, 4)[:count]


def _read_rest(files: SogFiles, meta: SogMeta) -> NDArray[np.float32]:  # [N, K - 1, 3]
    """The higher harmonics."""
    if meta.degree == 0:
        return np.zeros((meta.size, 0, 3), np.float32)
    centroids, indices = meta.files["shN"]
    labels = _pixels(files, indices, meta.size)[:, :2].astype(np.int64) @ np.array([1, 256])
    lines, K = -(-meta.palette // _PER_LINE), (meta.degree + 1) ** 2
    image = files.read_image(centroids, lines * (K - 1) * _PER_LINE, max(lines, 1024) * (K - 1) * _PER_LINE)
    if image.shape[1] != (K - 1) * _PER_LINE or len(image) < lines or labels.max(initial=-1) >= meta.palette:
        raise ValueError(
            f"the palette of harmonics has {image.shape[1]} x {len(image)} pixels, and an index of {labels.max(initial=-1)}; "
            f"expected {(K - 1) * _PER_LINE} x {lines}, and {meta.palette} rows"
        )
    return meta.tables["shN"][image.reshape(-1, K - 1, 4)[labels, :, :3]]


def _log_positions(means: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.sign(means) * np.log1p(np.abs(means))


def _encode(g: Gaussians) -> dict[str, bytes]:
    """The files of a scene."""
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
        **({"antialias": True, "model": "antialiased"} if g.antialiased else {}),
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": books["scales"].tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": books["sh0"].tolist(), "files": ["sh0.webp"]},
    }
    if g.sh.shape[1] > 1 and len(g):
        codebook, codes, labels = encode_rest(g.sh)
        padded = np.zeros((-(-len(codes) // _PER_LINE) * _PER_LINE, codes.shape[1]), np.uint8)
        padded[: len(codes)] = codes
        images["shN_centroids.webp"] = padded.reshape(len(padded) // _PER_LINE, -1, 3)
        images["shN_labels.webp"] = np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], 1)
        names, degree = ["shN_centroids.webp", "shN_labels.webp"], math.isqrt(g.sh.shape[1]) - 1
        meta["shN"] = {"count": len(codes), "bands": degree, "codebook": codebook.tolist(), "files": names}
    encoded = {name: _encode_image(pixels.astype(np.uint8)) for name, pixels in images.items()}
    return {META: json.dumps(meta, allow_nan=False).encode(), **encoded}


def encode_rest(sh: Tensor) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.int64]]:  # [N, K, 3]
    """Codebook [256], a palette of higher harmonics as its indices [P, (K - 1) * 3], and each Gaussian's row of it [N].

    The palette has 1,024 rows, doubled up to 65,536 for more Gaussians.
    """
    size = 1024 * min(64, 2 ** int(math.log2(max(len(sh), 1024) / 1024)))
    palette, labels = fit_palette(sh[:, 1:].flatten(1).float(), size)
    rows = palette.double().numpy()
    codebook = fit_codebook(rows)
    return codebook, nearest_codes(codebook, rows), labels.numpy()


def _encode_image(pixels: NDArray[np.uint8]) -> bytes:  # [n, 3 or 4] or [H, W, 3 or 4]
    """A lossless WebP image; rows of values become an image about as high as wide, its sides multiples of 4."""
    if pixels.ndim == 2:
        width = 4 * max(1, math.ceil(math.sqrt(len(pixels)) / 4))
        height = 4 * max(1, math.ceil(len(pixels) / width / 4))
        image = np.zeros((height * width, pixels.shape[1]), np.uint8)
        image[: len(pixels)] = pixels
        pixels = image.reshape(height, width, -1)
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "WEBP", lossless=True, exact=True, quality=50, method=4)
    return stream.getvalue()
