"""Files of `torch.save` that other people wrote, read by `torch.load(weights_only=True)`, which runs nothing they name.

torch refuses files that name classes it does not know, as the settings in Lightning's files do. Here each of these names
stands for an empty object; nothing is imported.
"""

from __future__ import annotations

import re
import threading
import warnings
import zipfile
from collections import Counter
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from torch import Tensor
from torch.serialization import get_unsafe_globals_in_checkpoint, safe_globals

from ._arrays import FileError, most_unpacked, reading

SAVE = "download it again, or save the state_dict() with torch.save or as .safetensors where you trust it"
_LOCK = threading.Lock()  # the names that torch allows are global
_KINDS = (
    (b"version https://git-lfs", "a Git LFS pointer, not the file itself: run `git lfs pull` where it came from"),
    (b"<", "an HTML or XML page: the download failed, most likely behind a login"),
    (b"{", "a JSON file, not the weights"),
    (b"\x1f\x8b", "a gzip file: unpack it first"),
)


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

    Raises:
        FileNotFoundError: if there is no such file. `expected` and `advice` are parts of the messages.
        FileError: if it is something else, damaged, or unpacks to much more than its size.
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
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(entry.file_size for entry in archive.infolist())
    if unpacked > most_unpacked(path.stat().st_size):
        raise ValueError(f"it would unpack to {unpacked} bytes")
    names = get_unsafe_globals_in_checkpoint(path)
    return [_Empty, *((_Empty if name.startswith("numpy") else type(name, (_Items,), {}), name) for name in names)]


def plain_tensor(path: Path, name: str, value: object, dtype: torch.dtype | None = torch.float32) -> Tensor:
    """A dense tensor of a file as numbers of `dtype` (None: its own), without its graph.

    Raises:
        FileError: if it is something else, or repeats its values by strides.
    """
    if not isinstance(value, Tensor) or value.layout != torch.strided or value.is_quantized or value.is_meta:
        kind = "another kind" if isinstance(value, Tensor) else type(value).__name__
        raise FileError(f"{path}: expected a dense tensor for {name}, got {kind}; is this another program's file?")
    held = value.untyped_storage().nbytes() // value.element_size()
    if value.numel() > held:  # a few bytes could fill the memory
        raise FileError(f"{path}: {name} has {list(value.shape)} values, the file only {held}; save it contiguous")
    return value.detach() if dtype is None else value.detach().to(dtype)
