"""Digests of what was scored, so that two scores can be known to be of the same data."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from ..gaussians import FACTS


def digest_data(value: Any) -> str:
    """SHA-256 of tensors, arrays, numbers, texts, and of lists, mappings, dataclasses and plain objects of them.

    Tensors count with their shape and type. Mappings are read in the order of their keys' text. A path counts as the bytes of
    its file.

    Raises:
        TypeError: if something else is among them.

    Example:
        >>> digest_data({"a": [1, 2]}) == digest_data({"a": (1, 2)})
        True
    """
    state = hashlib.sha256()
    _add(state, value)
    return state.hexdigest()


def _add(state: Any, value: Any) -> None:
    if isinstance(value, Tensor):
        value = value.detach().cpu().contiguous().numpy()
    if isinstance(value, np.ndarray):
        state.update(f"array {value.dtype} {value.shape};".encode())
        state.update(np.ascontiguousarray(value).tobytes())
    elif isinstance(value, bool | int | float | str | None):
        state.update(f"{type(value).__name__} {value!r};".encode())
    elif isinstance(value, Path):
        state.update(b"file;" + value.read_bytes())
    elif isinstance(value, Mapping):
        state.update(f"mapping {len(value)};".encode())
        for key in sorted(value, key=str):
            _add(state, str(key))
            _add(state, value[key])
    elif isinstance(value, list | tuple):
        state.update(f"list {len(value)};".encode())
        for one in value:
            _add(state, one)
    elif is_dataclass(value) and not isinstance(value, type):
        entries = {entry.name: (getattr(value, entry.name), entry.default) for entry in fields(value)}
        # facts of a cloud came later than its tensors: where there are none, old digests stay valid
        _add(state, {name: now for name, (now, usual) in entries.items() if name not in FACTS or now != usual})
    elif hasattr(value, "__dict__") and not isinstance(value, type):
        _add(state, vars(value))
    else:
        raise TypeError(f"value: expected tensors, numbers, texts or collections of them, got {type(value).__name__}")
