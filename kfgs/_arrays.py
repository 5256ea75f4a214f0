"""Read arrays and tensors from files that others wrote: `.npy`, `.npz`, `.safetensors`; write the last.

Nothing pickled is ever loaded, and an archive unpacks to a limited size. What is wrong with a file becomes one `FileError`.
"""

from __future__ import annotations

import json
import struct
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

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
    with reading(path, expected, advice):
        return _numbers(np.lib.format.open_memmap(as_path(path), mode="r"))


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
        total = sum(entry.file_size for entry in archive.infolist())
        most = most_unpacked(as_path(path).stat().st_size) if most is None else most
        if total > most:
            raise ValueError(f"it would unpack to {total} bytes, expected at most {most}")
        with np.load(as_path(path), allow_pickle=False) as arrays:
            return {name: _numbers(array) for name, array in arrays.items()}


def _numbers(array: Any) -> Array:
    """An array of numbers or texts that numpy read, as it is; a ValueError for anything else."""
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "biufcU" or array.nbytes < array.size:
        raise ValueError(f"it holds {getattr(array, 'dtype', 'several arrays')}, not numbers or texts")
    return array


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
    with reading(path, expected, advice), safe_open(path, framework="pt") as file:
        metadata = dict(file.metadata() or {})
        kind, version = (metadata.get(key) for key in ("kfgs", "version"))
        if kfgs is None or (kind, version) == kfgs:
            return {name: file.get_tensor(name) for name in file.keys()}, metadata  # noqa: SIM118 (no mapping)
    what = one_line(kind) if kind else "other tensors"
    if kind == kfgs[0]:
        what, advice = f"version {one_line(version)}", "use the kfgs that wrote it"
    raise FileError(f"{path}: expected a kfgs {kfgs[0]}, version {kfgs[1]}, got {what}; {advice}")


def save_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None) -> None:
    """Write tensors from any device, with texts in the header, in their order (safetensors alone would shuffle them)."""
    whole = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    save_file(whole, path, metadata=None if metadata is None else dict(metadata))
    if metadata is None or len(metadata) < 2:
        return
    with path.open("r+b") as file:
        (length,) = struct.unpack("<Q", file.read(8))
        header = json.loads(file.read(length))
        header["__metadata__"] = dict(metadata)
        ordered = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
        assert len(ordered) <= length, "the same texts in another order"
        file.seek(8)
        file.write(ordered.ljust(length))


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
