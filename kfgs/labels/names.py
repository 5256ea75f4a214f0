"""Classes by name or by index, as arguments of labels and edits name them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from .._check import check_whole
from .._names import class_index as class_index
from .._names import class_indices as class_indices


def class_of(argument: str, value: Any) -> str | int:
    """Check that a value is a class name, or an index from -1 (none). A ValueError names the `argument`."""
    plain = value.tolist() if hasattr(value, "tolist") else value  # numbers and strings of numpy and torch
    if isinstance(plain, str):
        return plain
    check_whole(argument, plain, -1, 2**31 - 1)
    return int(plain)


def labelled(labels: Tensor, asked: str | int, classes: Sequence[str]) -> Tensor:  # [N] int64 -> [N] bool
    """Which labels belong to a class, given by index or by name (see `class_indices`)."""
    wanted = class_indices(asked, classes) if isinstance(asked, str) else (asked,)
    return torch.isin(labels, torch.tensor(wanted, dtype=torch.int64, device=labels.device))
