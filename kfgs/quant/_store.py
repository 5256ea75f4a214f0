"""Named tensors in one .safetensors file with its kind in the header. Files are written whole or not at all; no pickle."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from safetensors import SafetensorError, safe_open
from torch import Tensor

from .._files import as_path, atomic_path
from .._tensors import save_tensors

KIND, VERSION = "kfgs", "1"  # the metadata's key for the kind of file, and the version of all of them


def write_tensors(path: str | Path, tensors: Mapping[str, Tensor], *, kind: str) -> None:
    """Write tensors (copied to the CPU) and their kind."""
    with atomic_path(path) as temporary:
        save_tensors(temporary, tensors, {KIND: kind, "version": VERSION})


def read_tensors(path: str | Path, *, kind: str) -> dict[str, Tensor]:
    """Read tensors, refusing a file of another kind.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no .safetensors file, or is of another kind.
    """
    path = as_path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected a kfgs {kind} (.safetensors) there")
    try:
        with safe_open(path, framework="pt") as file:
            found = (file.metadata() or {}).get(KIND)
            if found != kind:
                raise ValueError(f"{path}: expected a kfgs {kind}, got {found or 'other tensors'}; pass another file")
            return {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (the handle is no mapping)
    except SafetensorError as error:
        raise ValueError(f"{path}: expected a kfgs {kind} (.safetensors), but it cannot be read ({error})") from error
