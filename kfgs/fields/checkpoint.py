"""The state of an unfinished fit in one file, so that a killed run can continue (on a CPU with bit-equal results)."""

from __future__ import annotations

import hashlib
import io
import pickle
import zipfile
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .._files import atomic_path

DAMAGED = (pickle.UnpicklingError, zipfile.BadZipFile, RuntimeError, LookupError, TypeError, ValueError, EOFError)


def digest_tensors(*tensors: Tensor) -> str:
    """SHA-256 over shapes, dtypes and values, in hexadecimal."""
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(f"{tuple(tensor.shape)}{tensor.dtype}".encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def write_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write the file; it is whole or absent. Its folder was made at the start and is not made again."""
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path.parent}: expected this folder to stay while Gaussians are trained; start again")
    buffer = io.BytesIO()  # torch.save reports a full disk as a bug of its own, with a traceback
    torch.save(state, buffer)
    with atomic_path(path) as temporary:
        temporary.write_bytes(buffer.getbuffer())


def read_checkpoint(path: Path, identity: dict[str, str]) -> dict[str, Any]:
    """Read the file; a ValueError if it is damaged, or belongs to a fit with other inputs."""
    advice = "delete it to start again, or give another path"
    try:
        with path.open("rb") as file:
            state = torch.load(file, map_location="cpu", weights_only=True)
        known = dict(state["identity"])
    except DAMAGED as error:
        raise ValueError(f"{path}: expected a checkpoint of kfgs, got another or a damaged file; {advice}") from error
    differing = sorted(name for name in identity | known if identity.get(name) != known.get(name))
    if differing:
        raise ValueError(
            f"checkpoint: expected one of this very fit at {path}, got one with other {', '.join(differing)}; {advice}"
        )
    return dict(state)
