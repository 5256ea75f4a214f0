"""Named tensors in one .safetensors file with its kind in the header. Files are written whole or not at all; no pickle."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from .._arrays import read_safetensors
from .._files import atomic_path
from .._tensors import save_tensors

KIND, VERSION = "kfgs", "1"  # the metadata's key for the kind of file, and the version of all of them


def write_tensors(path: str | Path, tensors: Mapping[str, Tensor], *, kind: str) -> None:
    """Write tensors (copied to the CPU) and their kind."""
    with atomic_path(path) as temporary:
        save_tensors(temporary, tensors, {KIND: kind, "version": VERSION})


def read_tensors(path: str | Path, *, kind: str) -> dict[str, Tensor]:
    """Read tensors, refusing a file of another kind or version.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no .safetensors file, or is of another kind or version.
    """
    return read_safetensors(path, f"a kfgs {kind} (.safetensors)", "pass another file", kfgs=(kind, VERSION))[0]
