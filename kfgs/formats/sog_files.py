"""The container of a SOG scene: a zip file or a folder of images, read in memory with size limits, and its `meta.json`."""

from __future__ import annotations

import io
import math
import warnings
import zipfile
import zlib
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
_BAD_ZIP = (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, NotImplementedError, ValueError)
_BAD_IMAGE = (ValueError, OSError, SyntaxError, Image.DecompressionBombError, Image.DecompressionBombWarning)


class SogFiles:
    """The files of one scene by name. Reads at most as many bytes as the caller allows, and writes nothing to disk.

    Args:
        path: a zip file, a folder, or the `meta.json` in it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._zip: zipfile.ZipFile | None = None
        self._folder = path if path.is_dir() else path.parent
        if path.is_file() and path.name != META:
            try:
                self._zip = zipfile.ZipFile(path)
            except _BAD_ZIP as error:
                raise ValueError(f"{path}: expected a zip file, but it cannot be opened ({error})") from error

    def __enter__(self) -> SogFiles:
        return self

    def __exit__(self, *_: object) -> None:
        if self._zip is not None:
            self._zip.close()

    def size(self) -> int:
        """Bytes of the zip file, or of all files in the folder."""
        if self._zip is not None:
            return self.path.stat().st_size
        return sum(file.stat().st_size for file in self._folder.iterdir() if file.is_file())

    def read(self, name: Any, limit: int) -> bytes:
        """The bytes of one file.

        Raises:
            ValueError: if there is no such file, its name is a path, or it is larger than `limit` or damaged.
        """
        if not isinstance(name, str) or not name or name in (".", "..") or set(name) & set("/\\:\0"):
            raise ValueError(
                f"{self.path}: expected the name of a file next to {META}, got {name!r:.80}; paths are refused"
            )
        try:
            if self._zip is None:
                with (self._folder / name).open("rb") as stream:
                    data = stream.read(limit + 1)
            else:
                info = self._zip.getinfo(name)
                if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise ValueError(f"zip method {info.compress_type}, not stored or deflated")
                with self._zip.open(info) as entry:
                    data = entry.read(limit + 1)  # whatever size the entry claims
        except (KeyError, FileNotFoundError) as error:
            raise ValueError(f"{self.path}: expected {name!r} in the scene, got no such file; copy it again") from error
        except _BAD_ZIP as error:
            raise ValueError(f"{self.path}: expected {name!r}, but it is damaged ({error}); export it again") from error
        if len(data) > limit:
            raise ValueError(
                f"{self.path}: expected {name!r} of at most {limit} bytes (from the count), got more; the file is damaged"
            )
        return data

    def read_meta(self) -> dict[str, Any]:
        """The content of `meta.json`."""
        try:
            meta = parse_json(self.read(META, _META_BYTES))
        except ValueError as error:
            raise ValueError(f"{self.path}: expected JSON in {META}, but it cannot be read ({error})") from error
        if not isinstance(meta, dict):
            raise ValueError(f"{self.path}: expected an object in {META}, got {type(meta).__name__}; export it again")
        return meta

    def read_image(self, name: Any, count: int, most: int | None = None) -> NDArray[np.uint8]:  # [H, W, 4]
        """Decode an image of at least `count` and at most `most` pixels (four times as many, and a few).

        Raises:
            ValueError: if it is not an image, or of another size; the size is checked before anything is decoded.
        """
        most = most or 4 * count + _SPARE_PIXELS
        data = self.read(name, 5 * most)  # lossless images of noise are hardly larger than their pixels
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", Image.DecompressionBombWarning)
                with Image.open(io.BytesIO(data), formats=("WEBP", "PNG")) as image:
                    width, height = image.size
                    if not count <= width * height <= most:
                        raise ValueError(f"{width} x {height} pixels for {count} values")
                    return np.asarray(image.convert("RGBA"))
        except _BAD_IMAGE as error:
            raise ValueError(
                f"{self.path}: expected {name!r} to be a lossless image of {count} values or a few more, got {error}; export "
                "it again"
            ) from error


class SogMeta(NamedTuple):
    """A checked `meta.json`; both versions have tables of 256 values for each channel."""

    size: int  # Gaussians
    bounds: tuple[list[float], list[float]]  # least and largest of each axis' logarithm
    tables: dict[str, NDArray[np.float32]]  # scales, sh0, shN: [3, 256]; NaN where there is no such code
    files: dict[str, list[Any]]  # names of images; `SogFiles.read` checks them
    logits: tuple[float, float] | None  # version 1: bounds of the opacity's logit
    palette: int | None  # rows of shN; None in version 1
    degree: int | None  # of shN; None in version 1
    mode: Mode


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
    shape = meta["means"].get("shape") if version == 1 and isinstance(meta.get("means"), dict) else None
    count = meta.get("count") if version == 2 else shape[0] if isinstance(shape, list) and shape else None
    if type(count) is not int or count < 0:
        raise _wrong(path, "count", "a number of Gaussians", count)
    groups = {"means": 2, "scales": 1, "quats": 1, "sh0": 1} | ({"shN": 2} if meta.get("shN") else {})
    files = {name: _get(path, meta, name, "files") for name in groups}
    for name, number in groups.items():
        if not isinstance(files[name], list) or len(files[name]) != number:
            raise _wrong(path, f"{name}.files", f"{number} names", files[name])
    fit = _table_v1 if version == 1 else _table_v2
    tables = {name: fit(path, meta, name) for name in files if name not in ("means", "quats")}
    palette = degree = logits = None
    if version == 2 and "shN" in files:
        palette, degree = (_whole(path, meta, key, most) for key, most in (("count", 1 << 16), ("bands", 4)))
    check_count(path, count, (degree or 3) if "shN" in files else 0, size)
    if version == 1:
        ends = [_numbers(path, _get(path, meta, "sh0", key), f"sh0.{key}", 4)[3] for key in ("mins", "maxs")]
        logits = (ends[0], ends[1])
    low, high = (_numbers(path, _get(path, meta, "means", key), f"means.{key}", 3) for key in ("mins", "maxs"))
    return SogMeta(count, (low, high), tables, files, logits, palette, degree, mode_from_meta(meta))


def _wrong(path: Path, where: str, expected: str, got: object) -> ValueError:
    return ValueError(f"{path}: expected {expected} as '{where}' of {META}, got {got!r:.80}; export it again")


def _get(path: Path, meta: dict[str, Any], group: str, key: str) -> Any:
    values = meta.get(group)
    if not isinstance(values, dict) or key not in values:
        raise _wrong(path, f"{group}.{key}", "a value", values)
    return values[key]


def _numbers(path: Path, values: Any, name: str, least: int, most: int | None = None) -> list[float]:
    """A list of finite numbers, as floats."""
    fine = isinstance(values, list) and least <= len(values) <= (most or least)
    if not fine or not all(type(v) in (int, float) and abs(v) < 1e38 for v in values):  # NaN is not < 1e38
        raise _wrong(path, name, f"{least} finite numbers", values)
    return [float(v) for v in values]


def _whole(path: Path, meta: dict[str, Any], key: str, most: int) -> int:
    value = _get(path, meta, "shN", key)
    if type(value) is not int or not 1 <= value <= most:
        raise _wrong(path, f"shN.{key}", f"1 to {most}", value)
    return value


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
