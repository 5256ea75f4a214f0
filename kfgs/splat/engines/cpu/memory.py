"""Large arrays that a frame needs and the next frame needs again.

Handing memory back to Linux and asking for it again costs as much as the compositing of it: every page is cleared when it
is touched first (measured at 480x360x512 on two threads: 89 ms per frame with memory that is there, 180 ms without). So
the largest arrays of the last calls are kept, and given out again once nothing else refers to them.
"""

from __future__ import annotations

import math
import sys
import threading

import numpy as np
import torch
from torch import Tensor

CACHE_LINE = 64
"""Bytes of a cache line: a vector that straddles two costs double."""

SMALLEST_KEPT = 1 << 20
"""Bytes below which memory comes from the C library, which keeps so much by itself."""

MOST_KEPT = 1 << 30
"""Bytes that are kept at most, by each thread."""


def _counts_references() -> bool:
    """Whether one can go by the count of references: not in a Python without its global lock, and not if it is lazy."""
    probe = [np.empty(1)]
    alone, tensor = sys.getrefcount(probe[0]), torch.from_numpy(probe[0][:])
    shared = sys.getrefcount(probe[0])
    del tensor
    return getattr(sys, "_is_gil_enabled", lambda: True)() and (alone, shared) == (2, 3)


_COUNTS = _counts_references()


class _Kept(threading.local):
    def __init__(self) -> None:
        self.buffers: list[np.ndarray] = []


_kept = _Kept()


def take_memory(like: Tensor, *shape: int) -> Tensor:
    """Memory of the tensor's dtype, not initialised, that begins on a cache line.

    It is the caller's until the last tensor on it is gone: whether that is so is told by Python's count of references.
    """
    size = math.prod(shape) * like.element_size()
    if size < SMALLEST_KEPT or not _COUNTS:
        return like.new_empty(shape)
    buffer = _find(size)
    if buffer is None:
        buffer = np.empty(
            size + CACHE_LINE, np.uint8
        )  # of so much, numpy asks Linux for large pages, and torch does not
        if size <= MOST_KEPT:
            _kept.buffers.append(buffer)
            while sum(kept.nbytes for kept in _kept.buffers) > MOST_KEPT:
                del _kept.buffers[0]
    skip = -buffer.ctypes.data % CACHE_LINE
    # Shaped by numpy: to autograd, a view of a tensor would be another thing than a tensor.
    dtype = like.new_empty(0).numpy().dtype
    return torch.from_numpy(buffer[skip : skip + size].view(dtype).reshape(shape))


def free_memory() -> None:
    """Hand back what this thread keeps for its next frames: up to 1 GiB of maps and gradients nobody uses any more."""
    _kept.buffers.clear()


def _find(size: int) -> np.ndarray | None:
    """A kept buffer that nobody uses, large enough and at most twice as large; it counts as the latest from now on."""
    buffers = _kept.buffers
    for i in range(len(buffers)):
        # Referred to by the list and by the call: a tensor on it would be a third.
        if size + CACHE_LINE <= buffers[i].nbytes <= 2 * (size + CACHE_LINE) and sys.getrefcount(buffers[i]) == 2:
            buffers.append(buffers.pop(i))
            return buffers[-1]
    return None
