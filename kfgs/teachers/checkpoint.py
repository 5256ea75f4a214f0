"""Checkpoints: the state dict of a `.ckpt`, `.pt`, `.pth` or `.safetensors` file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torch import Tensor

from .._arrays import SAVE, plain_tensor, read_safetensors, read_torch
from .._check import one_line
from .._files import as_path

_EXPECTED = "a checkpoint (.ckpt, .pt, .pth or .safetensors)"
_STATES = ("state_dict", "model_state_dict", "model", "module", "net", "network", "params")  # usual keys


def read_checkpoint(path: str | Path) -> dict[str, Tensor]:
    """Read the tensors of a checkpoint by name, on the CPU. Nothing in the file is run, and values are not read yet.

    Files of `torch.save` and safetensors are read; the content shows which it is. The state dict is the whole file, or is
    under `state_dict` (Lightning), `model_state_dict`, `model`, `module`, `net`, `network` or `params`, in this order.
    Anything that is not a tensor is left out.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a checkpoint, or is damaged.
    """
    path = as_path(path)
    if path.is_dir():
        raise ValueError(f"{path}: expected {_EXPECTED}, got a folder; name the file of weights in it")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected {_EXPECTED}, got no such file; check its name")
    with path.open("rb") as file:
        head = file.read(9)
    if head[8:9] == b"{" and int.from_bytes(head[:8], "little") < 2**27:  # the length of a JSON header, below 100 MB
        return read_safetensors(path, _EXPECTED, SAVE)[0]
    top = read_torch(path, _EXPECTED)
    state = _find_state(top)
    if state is None:
        keys = ", ".join(one_line(key, 30) for key in list(top)[:5]) if isinstance(top, dict) else type(top).__name__
        raise ValueError(
            f"{path}: expected {_EXPECTED}, got one without a state dict (names to tensors): {keys}; {SAVE}"
        )
    return {
        name: plain_tensor(path, one_line(name), value, None)
        for name, value in state.items()
        if isinstance(name, str) and isinstance(value, Tensor)
    }


def _find_state(top: Any, depth: int = 0) -> dict[Any, Any] | None:
    """The dict that holds tensors, or the one under one of the usual keys."""
    if not isinstance(top, dict) or depth > 3:
        return None
    inner = (_find_state(top.get(key), depth + 1) for key in _STATES)
    outer = top if any(isinstance(value, Tensor) for value in top.values()) else None
    return next((state for state in inner if state is not None), outer)
