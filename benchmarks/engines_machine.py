"""What the machine is and can do, and how long, how evenly and with how much memory something runs on it."""

from __future__ import annotations

import os
import platform
import re
import resource
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numba
import torch
from devices import CPU, clock


class Times(NamedTuple):
    """Seconds of wall-clock time."""

    median: float
    least: float
    runs: int


def measure(calls: dict[str, Callable[[], Any]], repeats: int, *, slow: float = 1.0) -> dict[str, Times]:
    """Time the calls in turn, round after round, after a first one that is not counted.

    What a noisy neighbour takes, it takes from all of them. A call longer than `slow` seconds is timed in three rounds.
    """
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    rounds = {name: repeats if clock(call) < slow else min(3, repeats) for name, call in calls.items()}
    for turn in range(repeats):
        for name, call in calls.items():
            if turn < rounds[name]:
                seconds[name].append(clock(call))
    return {name: Times(sorted(s)[len(s) // 2], min(s), len(s)) for name, s in seconds.items()}


class Peak(NamedTuple):
    """What the processor reaches with this many threads, or the GPU."""

    flops: float  # multiply and add counted as two, per second
    bandwidth: float  # bytes per second, read and written


def measure_peak(device: torch.device = CPU, repeats: int = 5) -> Peak:
    """The rate of a float32 matrix product (torch's BLAS), and of copying 256 MiB; the best of a few.

    The matrices are 1536 x 1536, on a GPU 8192 x 8192.
    """
    n = 1536 if device.type == "cpu" else 8192
    a, b, out = torch.randn(n, n, device=device), torch.randn(n, n, device=device), torch.empty(n, n, device=device)
    source, target = torch.zeros(1 << 26, device=device), torch.zeros(1 << 26, device=device)
    times = measure({"product": lambda: torch.mm(a, b, out=out), "copy": lambda: target.copy_(source)}, repeats)
    return Peak(2 * n**3 / times["product"].least, 2 * 4 * (1 << 26) / times["copy"].least)


def describe(device: torch.device = CPU) -> dict[str, Any]:
    """The processor, its vector units, the GPU that is used (or None) and the versions, without names of hosts or users."""
    flags: list[str] = []
    model = platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        text = cpuinfo.read_text()
        found = re.search(r"^flags\s*:(.*)$", text, re.MULTILINE)
        words = found.group(1).split() if found else []
        flags = [flag for flag in ("sse4_2", "avx", "avx2", "fma", "avx512f", "amx_tile") if flag in words]
        name = re.search(r"^model name\s*:(.*)$", text, re.MULTILINE)
        model = name.group(1).strip() if name else model
    return {
        "processor": model,
        "cores": os.cpu_count(),
        "flags": flags,
        "gpu": torch.cuda.get_device_name(device) if device.type == "cuda" else None,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numba": numba.__version__,
        "system": platform.system(),
    }


def peak_memory(call: Callable[[], Any], device: torch.device = CPU) -> int:
    """Bytes by which memory rose at most during the call: the process's resident memory, or what torch allocates on a GPU.

    Linux can forget the highest mark so far; elsewhere, memory that was used and freed before the call hides a rise.
    """
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        held = torch.cuda.memory_allocated(device)
        call()
        return torch.cuda.max_memory_allocated(device) - held
    before = _status("VmRSS")
    if before is None:
        highest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        call()
        return (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - highest) * 1024
    Path("/proc/self/clear_refs").write_text("5")
    call()
    after = _status("VmHWM")
    assert after is not None
    return after - before


def _status(name: str) -> int | None:
    path = Path("/proc/self/status")
    if not path.exists():
        return None
    found = re.search(rf"^{name}:\s*(\d+) kB", path.read_text(), re.MULTILINE)
    return int(found.group(1)) * 1024 if found else None
