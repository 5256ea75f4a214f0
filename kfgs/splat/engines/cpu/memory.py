"""Large arrays, kept from one frame for the next.

Linux clears every page of new memory, which costs as much as compositing (at 480x360x512 on two threads: 180 ms per frame
with new memory, 89 ms with kept memory). So the largest arrays are kept, and given out again when nothing refers to them.
"""

from __future__ import annotations

import math
import sys
import threading

import numpy as np
import torch
from torch import Tensor

CACHE_LINE = 64
"""Bytes of a cache line: a vector that lies in two of them costs double."""

SMALLEST_KEPT = 1 << 20
"""Bytes. Less memory than this comes from the C library, which keeps small pieces itself."""

MOST_KEPT = 1 << 30
"""The most bytes that each thread keeps."""


def _counts_references() -> bool:
    """Whether reference counts are exact here: not in a Python without its global lock, or one that counts lazily."""
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

    It belongs to the caller until the last tensor on it is gone, which Python's reference count tells.
    """
    size = math.prod(shape) * like.element_size()
    if size < SMALLEST_KEPT or not _COUNTS:
        return like.new_empty(shape)
    buffers, buffer = _kept.buffers, None
    for i in range(len(buffers)):  # an unused one that is large enough, and at most twice too large, becomes the latest
        # Two references: the list and the call. A tensor on the buffer would be a third.
        if size + CACHE_LINE <= buffers[i].nbytes <= 2 * (size + CACHE_LINE) and sys.getrefcount(buffers[i]) == 2:
            buffers.append(buffers.pop(i))
            buffer = buffers[-1]
            break
    if buffer is None:
        buffer = np.empty(size + CACHE_LINE, np.uint8)  # numpy asks Linux for large pages, and torch does not
        if size <= MOST_KEPT:
            _kept.buffers.append(buffer)
            while sum(kept.nbytes for kept in _kept.buffers) > MOST_KEPT:
                del _kept.buffers[0]
    skip = -buffer.ctypes.data % CACHE_LINE
    # Shaped by numpy, because autograd treats a view of a tensor differently from a tensor.
    dtype = like.new_empty(0).numpy().dtype
    return torch.from_numpy(buffer[skip : skip + size].view(dtype).reshape(shape))


def flat(tensor: Tensor) -> np.ndarray:
    """The tensor's memory as numpy sees it, in one dimension."""
    return tensor.detach().contiguous().view(-1).numpy()


def free_memory() -> None:
    """Free the memory that this thread keeps for its next frames: up to 1 GiB of unused maps and gradients."""
    _kept.buffers.clear()
