"""Run a compiled kernel over numbered bands of work on a few threads.

Numba's parallel loops are not used: one back end aborts when two Python threads enter it, another does not survive a fork,
and both split the work by the number of threads. Here the data fix the bands, so results do not depend on the threads.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..contract import ALPHA_MIN

_PIECE = 16384
"""Below the size at which torch wakes its own threads, which wait for each other; the bands' threads do not."""

_pools: dict[int, ThreadPoolExecutor] = {}  # by process: threads do not survive a fork


def _pool() -> ThreadPoolExecutor:
    pool = _pools.get(os.getpid())
    if pool is None:  # two threads may get here at once: one pool is kept, the other has started nothing yet
        made = ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="kfgs")
        pool = _pools.setdefault(os.getpid(), made)
    return pool


def run_bands(kernel: Callable[..., None], bands: int, *arguments: Any) -> None:
    """Call `kernel(band, *arguments)` for every band, on up to `torch.get_num_threads()` threads.

    Args:
        kernel: releases the GIL, and writes nothing that another band reads or writes.
        bands: their number; each thread takes the next one.
        arguments: passed on as they are.
    """
    remaining = iter(range(bands))

    def drain() -> None:
        for band in remaining:
            kernel(band, *arguments)

    helpers = min(torch.get_num_threads(), bands) - 1
    futures = [_pool().submit(drain) for _ in range(helpers)]
    drain()
    for future in futures:
        future.result()


@torch.no_grad()
def find_reach(opacities: Tensor) -> np.ndarray:  # [M] -> [M]
    """The largest d^T C d at which opacity * exp(-0.5 d^T C d) >= ALPHA_MIN; not positive for a fainter Gaussian.

    torch's logarithm, so that it is the one of `kfgs.splat.project` and `kfgs.splat.tiles` to the bit.
    """
    pieces = opacities.detach().split(_PIECE)
    out = np.empty(len(opacities), opacities.detach().numpy().dtype)

    def fill(band: int) -> None:
        out[band * _PIECE : (band + 1) * _PIECE] = torch.log(pieces[band] / ALPHA_MIN).mul_(2).numpy()

    run_bands(fill, len(pieces))
    return out
