"""The state of an unfinished fit in one file, so that a killed run can continue (on a CPU with bit-equal results)."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .._arrays import reading
from .._files import atomic_path

AGAIN = "delete it to start again, or give another path"


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


def read_checkpoint(path: Path, identity: str) -> dict[str, Any]:
    """Read the file; a ValueError if it is damaged, or belongs to a fit with other inputs."""
    with reading(path, "a checkpoint of kfgs", AGAIN), path.open("rb") as file:
        state = dict(torch.load(file, map_location="cpu", weights_only=True))
        known = state["identity"]
    if known != identity:
        got = f"one with other Gaussians, views, options, loss or seed; {AGAIN}"
        raise ValueError(f"checkpoint: expected one of this very fit at {path}, got {got}")
    return state
