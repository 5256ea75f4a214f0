"""Check the `meta.json` of a SOG scene; both versions are read into tables of 256 values for each channel."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._card import short_repr
from .render_mode import Mode, mode_from_meta
from .values import check_count


class SogMeta(NamedTuple):
    """A checked `meta.json`."""

    gaussians: int
    bounds: tuple[list[float], list[float]]  # least and largest of each axis' logarithm
    tables: dict[str, NDArray[np.float32]]  # scales, sh0, shN: [3, 256]; NaN where there is no such code
    files: dict[str, list[Any]]  # names of images; the container checks them
    logits: tuple[float, float] | None  # version 1: bounds of the opacity's logit
    palette: int | None  # rows of shN; None in version 1
    degree: int | None  # of shN; None in version 1
    mode: Mode

    def __repr__(self) -> str:
        return short_repr(self)


def parse_meta(path: Path, meta: dict[str, Any], size: int) -> SogMeta:
    """Check version 1 (no `version`) or 2.

    Args:
        path: the file, for errors.
        meta: the parsed JSON.
        size: bytes of the whole scene, which limit the count of Gaussians.

    Raises:
        ValueError: if a key is missing or of another kind, or the count cannot be true.
    """
    version = meta.get("version", 1)
    if version not in (1, 2) or isinstance(version, bool):
        raise ValueError(f"{path}: expected SOG version 1 or 2, got {version!r:.40}; export it as version 2")
    shapes = _get(path, meta, "means", "shape") if version == 1 else None
    count = meta.get("count") if version == 2 else shapes[0] if isinstance(shapes, list) and shapes else None
    if type(count) is not int or count < 0:
        raise ValueError(f"{path}: expected a count of Gaussians, got {count!r:.40}; the file is damaged")
    groups = {"means": 2, "scales": 1, "quats": 1, "sh0": 1} | ({"shN": 2} if meta.get("shN") else {})
    files = {name: _file_names(path, meta, name, number) for name, number in groups.items()}
    fit = _table_v1 if version == 1 else _table_v2
    tables = {name: fit(path, meta, name) for name in files if name not in ("means", "quats")}
    palette = degree = None
    if version == 2 and "shN" in files:
        palette = _whole(path, meta, "count", 1, 1 << 16)
        degree = _whole(path, meta, "bands", 1, 4)
    check_count(path, count, (degree or 3) if "shN" in files else 0, size)
    logits = None
    if version == 1:
        ends = [_numbers(path, _get(path, meta, "sh0", key), f"sh0.{key}", 4)[3] for key in ("mins", "maxs")]
        logits = (ends[0], ends[1])
    low, high = (_numbers(path, _get(path, meta, "means", key), f"means.{key}", 3) for key in ("mins", "maxs"))
    return SogMeta(count, (low, high), tables, files, logits, palette, degree, mode_from_meta(meta))


def _get(path: Path, meta: dict[str, Any], group: str, key: str) -> Any:
    values = meta.get(group)
    if not isinstance(values, dict) or key not in values:
        raise ValueError(f"{path}: expected '{group}.{key}' in meta.json, got {values!r:.80}; export it again")
    return values[key]


def _numbers(path: Path, values: Any, name: str, least: int, most: int | None = None) -> list[float]:
    """A list of finite numbers, as floats."""
    fine = isinstance(values, list) and least <= len(values) <= (most or least)
    if not fine or not all(type(v) in (int, float) and abs(v) < 1e38 for v in values):  # NaN is not < 1e38
        raise ValueError(
            f"{path}: expected {least} finite numbers in '{name}' of meta.json, got {values!r:.80}; export it again"
        )
    return [float(v) for v in values]


def _whole(path: Path, meta: dict[str, Any], key: str, low: int, high: int) -> int:
    value = _get(path, meta, "shN", key)
    if type(value) is not int or not low <= value <= high:
        raise ValueError(
            f"{path}: expected 'shN.{key}' from {low} to {high} in meta.json, got {value!r:.40}; export again"
        )
    return value


def _file_names(path: Path, meta: dict[str, Any], group: str, number: int) -> list[Any]:
    names = _get(path, meta, group, "files")
    if not isinstance(names, list) or len(names) != number:
        raise ValueError(
            f"{path}: expected {number} names in '{group}.files' of meta.json, got {names!r:.80}; export again"
        )
    return names


def _table_v1(path: Path, meta: dict[str, Any], group: str) -> NDArray[np.float32]:  # [3, 256]
    """256 even steps between the bounds, which are one pair for all of shN."""
    ends = []
    for key in ("mins", "maxs"):
        values = _get(path, meta, group, key)
        values = [values] * 3 if not isinstance(values, list) else values
        ends.append(np.array(_numbers(path, values, f"{group}.{key}", 3, 4)[:3]))
    return (ends[0][:, None] + (ends[1] - ends[0])[:, None] * (np.arange(256) / 255)).astype(np.float32)


def _table_v2(path: Path, meta: dict[str, Any], group: str) -> NDArray[np.float32]:  # [3, 256]
    """One codebook for the three channels. Some early writers left null in its first place: a step below the second."""
    codebook = _get(path, meta, group, "codebook")
    if isinstance(codebook, list) and len(codebook) == 256 and codebook[0] is None:
        rest = _numbers(path, codebook[1:], f"{group}.codebook", 255)
        codebook = [rest[0] + (rest[0] - rest[-1]) / 255, *rest]
    numbers = _numbers(path, codebook, f"{group}.codebook", 1, 256)
    return np.tile(np.array(numbers + [math.nan] * (256 - len(numbers)), np.float32), (3, 1))
