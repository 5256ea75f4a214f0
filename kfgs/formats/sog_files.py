"""The container of a SOG scene: a zip file or a folder of images, read in memory with size limits, and its `meta.json`."""

from __future__ import annotations

import io
import math
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from .._files import parse_json
from .render_mode import Mode, mode_from_meta
from .values import check_count

META = "meta.json"
_META_BYTES = 1 << 22  # three codebooks of 256 numbers and a few names take 20 KB
_SPARE_PIXELS = 1 << 16  # unused pixels that an image may have


class SogMeta(NamedTuple):
    """A checked `meta.json`."""

    size: int  # Gaussians
    bounds: tuple[NDArray[np.float64], NDArray[np.float64]]  # [3] least and largest of each axis' logarithm
    tables: dict[str, NDArray[np.float32]]  # scales, sh0, shN: [256]; NaN where there is no such code
    files: dict[str, list[Any]]  # names of images; `SogFiles.read` checks them
    palette: int  # rows of shN
    degree: int  # of shN; 0: there is none
    mode: Mode


class SogFiles:
    """The files of one scene by name. Reads at most as many bytes as the caller allows, and writes nothing to disk."""

    def __init__(self, root: Path | zipfile.Path, size: int) -> None:
        self._root, self._size = root, size

    def read(self, name: Any, limit: int) -> bytes:
        """The bytes of one file; a ValueError if its name is a path, or it is larger than `limit`."""
        if not isinstance(name, str) or not name or name in (".", "..") or set(name) & set("/\\:\0"):
            raise ValueError(f"it names the file {name!r:.60}; expected one next to {META}, paths are refused")
        with (self._root / name).open("rb") as stream:
            data: bytes = stream.read(limit + 1)  # whatever size an entry of an archive claims
        if len(data) > limit:
            raise ValueError(f"{name!r:.60} has more than {limit} bytes (from the count)")
        return data

    def read_image(self, name: Any, count: int, most: int | None = None) -> NDArray[np.uint8]:  # [H, W, 4]
        """Decode a lossless image of at least `count` and at most `most` pixels (four times as many, and a few).

        Its size is checked before anything is decoded.
        """
        most = most or 4 * count + _SPARE_PIXELS
        data = self.read(name, 5 * most)  # lossless images of noise are hardly larger than their pixels
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data), formats=("WEBP", "PNG")) as image:
                width, height = image.size
                if not count <= width * height <= most:
                    raise ValueError(f"{name!r:.60} has {width} x {height} pixels for {count} values")
                return np.asarray(image.convert("RGBA"))

    def read_meta(self) -> SogMeta:
        """Read and check `meta.json`. A ValueError if the count cannot be true; a KeyError names a key that is missing."""
        meta = parse_json(self.read(META, _META_BYTES))
        if meta.get("version") != 2:
            raise ValueError(f"SOG version {meta.get('version', 1)!r:.40}; export it as version 2")
        count, rest = meta["count"], meta.get("shN") or {"count": 1, "bands": 0}
        groups = ["scales", "sh0", *(["shN"] if meta.get("shN") else [])]
        palette, degree = rest["count"], rest["bands"]
        if not 1 <= palette <= 1 << 16 or degree not in range(5):
            raise ValueError(f"a palette of {palette!r:.40} rows and degree {degree!r:.40}, not up to 65536 and 4")
        if type(count) is not int or count < 0:
            raise ValueError(f"{count!r:.40} is not a number of Gaussians")
        check_count(count, degree, self._size)
        low, high = (_numbers(meta["means"][key], 3) for key in ("mins", "maxs"))
        files = {name: list(meta[name]["files"]) for name in ("means", "quats", *groups)}
        tables = {name: _codebook(meta[name]["codebook"]) for name in groups}
        return SogMeta(count, (low, high), tables, files, palette, degree, mode_from_meta(meta))


@contextmanager
def open_scene(path: Path) -> Iterator[SogFiles]:
    """The files of a zip file or a folder."""
    if path.is_dir():
        yield SogFiles(path, sum(file.stat().st_size for file in path.iterdir() if file.is_file()))
        return
    with zipfile.ZipFile(path) as archive:
        for entry in archive.infolist():
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):  # these unpack in small parts
                raise ValueError(f"zip method {entry.compress_type}, not stored or deflated")
        yield SogFiles(zipfile.Path(archive), path.stat().st_size)


def _numbers(values: Any, least: int, most: int | None = None) -> NDArray[np.float64]:
    """A list of finite numbers."""
    numbers = np.array(values, np.float64)
    fine = numbers.ndim == 1 and least <= len(numbers) <= (most or least)
    if not fine or not (np.abs(numbers) < 1e38).all():
        raise ValueError(f"expected {least} finite numbers in {META}, got {values!r:.60}")
    return numbers


def _codebook(values: Any) -> NDArray[np.float32]:  # [256]
    """One codebook for the three channels. Some early writers left null in its first place: a step below the second."""
    if isinstance(values, list) and len(values) == 256 and values[0] is None:
        rest = _numbers(values[1:], 255)
        values = [rest[0] + (rest[0] - rest[-1]) / 255, *rest]
    numbers = _numbers(values, 1, 256)
    return np.pad(numbers, (0, 256 - len(numbers)), constant_values=math.nan).astype(np.float32)
