"""Read arrays and tensors from files that others wrote: `.npy`, `.npz`, `.safetensors`, files of `torch.save`.

Nothing that a file names is run or imported, and an archive unpacks to a limited size. What is wrong with a file becomes one
`FileError`, if it is missing a FileNotFoundError; `expected` and `advice` of all readers are parts of the messages.
"""

from __future__ import annotations

import json
import re
import struct
import threading
import warnings
import zipfile
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor
from torch.serialization import get_unsafe_globals_in_checkpoint, safe_globals

from ._check import one_line
from ._files import as_path

Array = NDArray[Any]
AGAIN = "copy it again, or write it again"
SAVE = "download it again, or save the state_dict() with torch.save or as .safetensors where you trust it"
_LOCK = threading.Lock()  # the names that torch allows are global
_KINDS = (
    (b"version https://git-lfs", "a Git LFS pointer, not the file itself: run `git lfs pull` where it came from"),
    (b"<", "an HTML or XML page: the download failed, most likely behind a login"),
    (b"{", "a JSON file, not the weights"),
    (b"\x1f\x8b", "a gzip file: unpack it first"),
)


class FileError(ValueError):
    """A file that cannot be read. The message names the file, what was expected, what is wrong, and what to do."""


def most_unpacked(packed: int) -> int:
    """The most bytes that a compressed file of `packed` bytes may take in memory, whatever its format (promises.md)."""
    return (64 << 20) + 100 * packed


def read_array(path: str | Path, expected: str = "an .npy file of numbers", advice: str = AGAIN) -> Array:
    """Map a `.npy` file of numbers into memory: values are read when they are used, and cannot be written."""
    with reading(path, expected, advice):
        return _numbers(np.lib.format.open_memmap(as_path(path), mode="r"))


def read_arrays(
    path: str | Path, expected: str = "an .npz file of arrays", advice: str = AGAIN, *, most: int | None = None
) -> dict[str, Array]:
    """Read all arrays of numbers and texts of an `.npz` file, by name; `most` bytes (None: what `most_unpacked` allows)."""
    with reading(path, expected, advice):
        _check_unpacked(as_path(path), most)
        with np.load(as_path(path), allow_pickle=False) as arrays:
            return {name: _numbers(array) for name, array in arrays.items()}


def _check_unpacked(path: Path, most: int | None = None) -> None:
    """Raise a ValueError if a zip archive would unpack to more bytes than it may."""
    with zipfile.ZipFile(path) as archive:
        total = sum(entry.file_size for entry in archive.infolist())
    most = most_unpacked(path.stat().st_size) if most is None else most
    if total > most:
        raise ValueError(f"it would unpack to {total} bytes, expected at most {most}")


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

    `kfgs`: the kind and the version that the metadata must state under "kfgs" and "version".
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

    A FileError of the block itself is raised as it is, and so is a PermissionError. A FileNotFoundError if there is no file.
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


class _Empty:
    """An object of an unknown class; it ignores its arguments and its state."""

    def __init__(self, *_: Any) -> None: ...
    def __setstate__(self, state: Any) -> None: ...


class _Items:
    """Stands for an unknown class that may derive from dict. Of all dicts, torch lets only a Counter have items and a state."""

    def __new__(cls, *_: Any) -> Any:
        return Counter()


def read_torch(path: Path, expected: str, advice: str = SAVE) -> Any:
    """The object in a file of `torch.save`, on the CPU. Tensors of a zip archive are views of the file.

    `torch.load(weights_only=True)` refuses files that name classes it does not know, as the settings in Lightning's files do.
    Here each of these names stands for an empty object; nothing is imported.
    """
    with reading(path, expected, advice):
        with path.open("rb") as file:
            head = file.read(64).lstrip()
        kind = next((words for start, words in _KINDS if head.startswith(start)), None)
        if kind is not None:
            raise FileError(f"{path}: expected {expected}, got {kind}; {advice}")
        zipped = head.startswith(b"PK")
        with _LOCK, warnings.catch_warnings(), safe_globals(_stand_ins(path) if zipped else []):
            warnings.simplefilter("ignore")  # about old storages
            try:
                return torch.load(path, map_location="cpu", mmap=zipped, weights_only=True)
            except UnpicklingError as error:  # a page of text, with the reason inside
                reason = re.split(r"\n\n|error: ", str(error).partition("\n\nCheck the documentation")[0].strip())[-1]
                raise ValueError(f"{reason.strip()} Nothing was run") from error


def _stand_ins(path: Path) -> list[Any]:
    """What torch makes for each name in an archive that it does not know."""
    _check_unpacked(path)
    names = get_unsafe_globals_in_checkpoint(path)
    return [_Empty, *((_Empty if name.startswith("numpy") else type(name, (_Items,), {}), name) for name in names)]


def plain_tensor(path: Path, name: str, value: object, dtype: torch.dtype | None = torch.float32) -> Tensor:
    """A dense tensor of a file as numbers of `dtype` (None: its own), without its graph.

    A FileError if it is something else, or repeats its values by strides.
    """
    if not isinstance(value, Tensor) or value.layout != torch.strided or value.is_quantized or value.is_meta:
        kind = "another kind" if isinstance(value, Tensor) else type(value).__name__
        raise FileError(f"{path}: expected a dense tensor for {name}, got {kind}; is this another program's file?")
    held = value.untyped_storage().nbytes() // value.element_size()
    if value.numel() > held:  # a few bytes could fill the memory
        raise FileError(f"{path}: {name} has {list(value.shape)} values, the file only {held}; save it contiguous")
    return value.detach() if dtype is None else value.detach().to(dtype)
