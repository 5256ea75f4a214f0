"""What this machine has at the moment: speed, memory and disk."""

from __future__ import annotations

import contextlib
import os
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

import torch


@dataclass(frozen=True)
class Speed:
    """What this machine does, at this moment."""

    flops: float
    """Operations per second of a float32 matrix product of 1024 x 1024, all threads."""
    threads: int
    device: str = "cpu"


def measure_speed(device: str | torch.device = "cpu", seconds: float = 0.3) -> Speed:
    """The best of several products of two 1024 x 1024 matrices."""
    device = torch.device(device)
    a, b = torch.ones(1024, 1024, device=device), torch.ones(1024, 1024, device=device)
    best, end = float("inf"), time.perf_counter() + seconds
    while time.perf_counter() < end or best == float("inf"):
        start = time.perf_counter()
        torch.mm(a, b)
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        best = min(best, time.perf_counter() - start)
    return Speed(2 * 1024**3 / best, torch.get_num_threads(), str(device))


def disk_free(folder: str | Path) -> int:
    """Bytes free where a folder is, or will be made."""
    path = Path(folder).resolve()
    while not path.exists():
        path = path.parent
    return shutil.disk_usage(path).free


def memory_free() -> int | None:
    """Bytes of memory that processes can still have, a container's limit counted; None where the system does not say."""
    found: list[int] = []
    meminfo, limit, used = (
        Path(name) for name in ("/proc/meminfo", "/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current")
    )
    try:
        lines = dict(line.split(":", 1) for line in meminfo.read_text().splitlines())
        found.append(int(lines["MemAvailable"].split()[0]) * 1024)
    except (OSError, KeyError, ValueError):
        found += _memory_of_pages()
    with contextlib.suppress(OSError, ValueError):  # no such container, or its limit is "max"
        found.append(int(limit.read_text()) - int(used.read_text()))
    return min(found) if found else None


def _memory_of_pages() -> list[int]:
    try:
        return [os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    except (AttributeError, OSError, ValueError):  # Windows, macOS
        return []
