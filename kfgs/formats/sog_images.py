"""The container of a SOG scene: a zip file or a folder with `meta.json` and images, read in memory with size limits."""

from __future__ import annotations

import io
import math
import warnings
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from .._files import parse_json

META = "meta.json"
_META_BYTES = 1 << 22  # three codebooks of 256 numbers and a few names take 20 KB
_SPARE_PIXELS = 1 << 16  # unused pixels that an image may have
_EPOCH = (1980, 1, 1, 0, 0, 0)  # a fixed date, so that equal scenes give equal files


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
            except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
                raise ValueError(f"{path}: expected a zip file, but it cannot be opened ({error})") from error

    def close(self) -> None:
        """Close the zip file."""
        if self._zip is not None:
            self._zip.close()

    def __enter__(self) -> SogFiles:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

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
        data = self._read_zip(name, limit) if self._zip is not None else self._read_folder(name, limit)
        if len(data) > limit:
            raise ValueError(
                f"{self.path}: expected {name!r} of at most {limit} bytes (from the count), got more; the file is damaged"
            )
        return data

    def _read_folder(self, name: str, limit: int) -> bytes:
        file = self._folder / name
        if not file.is_file():
            raise ValueError(f"{self.path}: expected {name!r} in the folder, got no such file; copy all of the scene")
        with file.open("rb") as stream:
            return stream.read(limit + 1)

    def _read_zip(self, name: str, limit: int) -> bytes:
        assert self._zip is not None
        try:
            info = self._zip.getinfo(name)
        except KeyError:
            raise ValueError(
                f"{self.path}: expected {name!r} in the zip file, got no such entry; export it again"
            ) from None
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError(
                f"{self.path}: expected {name!r} stored or deflated, got zip method {info.compress_type}; zip it again"
            )
        try:
            with self._zip.open(info) as stream:
                return stream.read(limit + 1)  # whatever size the entry claims
        except (
            zipfile.BadZipFile,
            zlib.error,
            EOFError,
            OSError,
            RuntimeError,
            NotImplementedError,
            ValueError,
        ) as error:
            raise ValueError(f"{self.path}: expected {name!r} in the zip file, but it is damaged ({error})") from error

    def read_meta(self) -> dict[str, Any]:
        """The content of `meta.json`."""
        data = self.read(META, _META_BYTES)
        try:
            meta = parse_json(data)
        except ValueError as error:
            raise ValueError(f"{self.path}: expected JSON in {META}, but it cannot be parsed ({error})") from error
        if not isinstance(meta, dict):
            raise ValueError(f"{self.path}: expected an object in {META}, got {type(meta).__name__}; export it again")
        return meta

    def read_image(self, name: Any, count: int, most: int | None = None) -> NDArray[np.uint8]:  # [H, W, 4]
        """Decode an image of at least `count` and at most `most` pixels (four times as many, and a few).

        Raises:
            ValueError: if it is no image, or of another size; the size is checked before anything is decoded.
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
        except (
            ValueError,
            OSError,
            SyntaxError,
            Image.DecompressionBombError,
            Image.DecompressionBombWarning,
        ) as error:
            raise ValueError(
                f"{self.path}: expected {name!r} to be a lossless image of {count} values or a few more, got {error}; export "
                "it again"
            ) from error


def encode_image(pixels: NDArray[np.uint8]) -> bytes:  # [n, 3 or 4] or [H, W, 3 or 4]
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


def write_zip(path: Path, files: dict[str, bytes]) -> None:
    """Write files side by side in one zip file, uncompressed (the images are) and without dates."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name, _EPOCH), data)
