"""Read arrays and tensors from files that others wrote: `.npy`, `.npz`, `.safetensors`.

A header can state any size. Here each is compared with the bytes that are there before memory is asked for, and nothing
pickled is ever loaded. What is wrong with a file becomes one `FileError`.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ._check import one_line
from ._files import as_path

Array = NDArray[Any]
AGAIN = "copy it again, or write it again"


class FileError(ValueError):
    """A file that cannot be read. The message names the file, what was expected, what is wrong, and what to do."""


def most_unpacked(packed: int) -> int:
    """The most bytes that a compressed file of `packed` bytes may take in memory, whatever its format (promises.md)."""
    return (64 << 20) + 100 * packed


def read_array(path: str | Path, expected: str = "an .npy file of numbers", advice: str = AGAIN) -> Array:
    """Map a `.npy` file into memory: values are read when they are used, and cannot be written.

    Raises:
        FileNotFoundError: if there is no such file. `expected` and `advice` are parts of the messages.
        FileError: if it is not a `.npy` file of numbers, is damaged or cut short, or states more values than it has.
    """
    with reading(path, expected, advice), as_path(path).open("rb") as file:
        _check_header(file, as_path(path).stat().st_size)
        array: Array = np.load(as_path(path), mmap_mode="r", allow_pickle=False)
        return array


def read_arrays(
    path: str | Path, expected: str = "an .npz file of arrays", advice: str = AGAIN, *, most: int | None = None
) -> dict[str, Array]:
    """Read all arrays of an `.npz` file, by name.

    Raises:
        FileNotFoundError: if there is no such file. `expected` and `advice` are parts of the messages.
        FileError: if it is not an `.npz` file of numbers and texts, is damaged, or unpacks to more than `most` bytes (None:
            what `most_unpacked` allows).
    """
    with reading(path, expected, advice), zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        total = sum(entry.file_size for entry in entries)
        most = most_unpacked(as_path(path).stat().st_size) if most is None else most
        if total > most:
            raise ValueError(f"it would unpack to {total} bytes, expected at most {most}")
        for entry in entries:
            with archive.open(entry) as file:
                _check_header(file, entry.file_size)
        with np.load(as_path(path), allow_pickle=False) as arrays:
            return dict(arrays)


def _check_header(file: IO[bytes], size: int) -> None:
    """Raise a ValueError unless a `.npy` file of `size` bytes holds the numbers or texts that its header states."""
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    if dtype.hasobject:
        raise ValueError("it holds pickled objects, which are never loaded")
    stated, rest = math.prod(shape) * dtype.itemsize, size - file.tell()
    lies = stated > rest or min(shape, default=1) < 0 or (dtype.itemsize == 0 and math.prod(shape) > 1)
    if lies or version > (2, 0) or dtype.kind not in "biufcU":
        raise ValueError(f"its header states numbers or texts {one_line(shape)} of {dtype}, {rest} bytes follow")


def read_safetensors(
    path: str | Path,
    expected: str = "a .safetensors file",
    advice: str = AGAIN,
    *,
    kfgs: tuple[str, str] | None = None,
) -> tuple[dict[str, Any], dict[str, str]]:
    """Read all tensors of a `.safetensors` file, and the texts of its metadata. Values are mapped, and read when used.

    Args:
        path: the file.
        expected, advice: parts of the messages.
        kfgs: the kind and the version that the metadata must state under "kfgs" and "version".

    Raises:
        FileNotFoundError: if there is no such file.
        FileError: if it is another file, damaged, cut short, or of another kind or version.
    """
    from safetensors import safe_open  # imports torch

    with reading(path, expected, advice), safe_open(path, framework="pt") as file:
        metadata = dict(file.metadata() or {})
        kind, version = (metadata.get(key) for key in ("kfgs", "version"))
        if kfgs is None or (kind, version) == kfgs:
            return {name: file.get_tensor(name) for name in file.keys()}, metadata  # noqa: SIM118 (no mapping)
    what = one_line(kind) if kind else "other tensors"
    if kind == kfgs[0]:
        what, advice = f"version {one_line(version)}", "use the kfgs that wrote it"
    raise FileError(f"{path}: expected a kfgs {kfgs[0]}, version {kfgs[1]}, got {what}; {advice}")


@contextmanager
def reading(path: str | Path, expected: str, advice: str = AGAIN) -> Iterator[None]:
    """Turn whatever fails while a file is read, and its content checked, into a `FileError`.

    Raises:
        FileNotFoundError: if there is no such file. `expected` and `advice` are parts of the messages.
        FileError: if the block fails. One of the block itself is raised as it is, and so is a PermissionError.
    """
    if not as_path(path).is_file():
        raise FileNotFoundError(f"{path}: no such file; expected {expected} there; {advice}")
    try:
        yield
    except (PermissionError, FileError):
        raise
    except Exception as error:  # hostile bytes raise almost anything: MemoryError, TokenError, OverflowError, ...
        kind = "" if isinstance(error, ValueError | OSError) else f"{type(error).__name__}: "
        why = f"{kind}{one_line(error, 160)}".rstrip(": ")
        raise FileError(f"{path}: expected {expected}, but it cannot be read ({why}); {advice}") from error
