"""Which engines there are, what they need, and where they run."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from threading import RLock
from typing import NamedTuple

import torch
from torch import Tensor

from ..._check import check_choice
from .contract import Engine


class _Entry(NamedTuple):
    module: str  # has the engine as ENGINE
    needs: str  # the package it imports; also what pip installs
    device: str | None  # for which "auto" takes it; None: any


_ENGINES = {
    "triton": _Entry("kfgs.splat.engines.triton.engine", "triton", "cuda"),
    "numba": _Entry("kfgs.splat.engines.cpu.engine", "numba", "cpu"),
    "reference": _Entry("kfgs.splat.engines.reference", "torch", None),
}
"""In order of preference: `engine="auto"` takes the first that knows the device and the dtype, and can be imported."""


def available_engines(device: str | None = None) -> list[str]:
    """Names of the engines whose packages are installed, the fastest first.

    Args:
        device: "cpu" or "cuda": only the engines for that device, which are imported to find out. None: all engines,
            and nothing is imported.
    """
    names = [name for name, entry in _ENGINES.items() if find_spec(entry.needs) and find_spec(entry.module)]
    return names if device is None else [name for name in names if _serves(name, device)]


def _serves(name: str, device: str) -> bool:
    try:
        return device in load(name).devices and _ENGINES[name].device in (device, None)  # import first (viz/plotter.py)
    except ImportError:  # installed, but broken on this machine
        return False


_FLAGS = RLock()  # guards the flags of dlopen; an engine may load another


@cache
def load(name: str) -> Engine:
    """The engine of a name; an ImportError with the line that installs its package if that cannot be used."""
    entry = _ENGINES[name]
    try:
        with _own_symbols():
            engine: Engine = import_module(entry.module).ENGINE
    except ImportError as error:
        raise ImportError(
            f"engine: expected {entry.needs} for engine {name!r}, but it cannot be imported ({error}); "
            f"install it with `pip install {entry.needs}`, or choose one of {available_engines()}"
        ) from error
    return engine


@contextmanager
def _own_symbols() -> Iterator[None]:
    """Import compiled modules so that their own functions come before those of others with the same names.

    triton brings an LLVM. If a picture was drawn before (pyvista on Mesa's software driver) and pycolmap is loaded, the
    linker offers Mesa's LLVM first, and Python ends with a segfault. The flag is set only then, because with it a module
    also ignores an allocator of LD_PRELOAD. numba is not affected: ctypes loads its LLVM.

    The flag holds for the whole process. So one import at a time sets it, and imports of other threads get it too.
    """
    flag = getattr(os, "RTLD_DEEPBIND", 0)  # glibc's
    maps = Path("/proc/self/maps")
    if not flag or not maps.is_file() or "libLLVM" not in maps.read_text(errors="replace"):
        yield
        return
    with _FLAGS:
        flags = sys.getdlopenflags()
        sys.setdlopenflags(flags | flag)
        try:
            yield
        finally:
            sys.setdlopenflags(flags)


@cache
def choose(engine: str, device: str, dtype: torch.dtype) -> Engine:
    """The engine for tensors of a device and a dtype: the fastest one for them if it is "auto".

    Raises:
        ValueError: if there is no such engine, or it does not run on the device or in the dtype.
        ImportError: if the named engine's package is missing.
    """
    if engine == "auto":
        known = (load(name) for name in available_engines(device) if dtype in load(name).dtypes)
        return next(known, load("reference"))
    check_choice("engine", engine, ["auto", *_ENGINES])
    chosen = load(engine)
    if device not in chosen.devices:
        raise ValueError(
            f"engine: expected one that runs on {device} (from means2d), got {engine!r} for {', '.join(chosen.devices)}; "
            "use engine='auto'"
        )
    if dtype not in chosen.dtypes:
        kinds = " or ".join(map(str, chosen.dtypes))
        raise ValueError(
            f"engine: expected one for {dtype} (from means2d), got {engine!r} for {kinds}; convert the Gaussians with "
            ".to(), or use engine='auto'"
        )
    return chosen


def choose_projecting(engine: str, *tensors: Tensor) -> Engine | None:
    """The engine, if it projects, shades and bins these tensors itself. None: kornia's and torch's functions do it."""
    chosen = choose(engine, tensors[0].device.type, tensors[0].dtype)
    return chosen if chosen.projects and len({(value.device, value.dtype) for value in tensors}) == 1 else None


def compiled_ssim(*tensors: Tensor) -> Callable[..., tuple[Tensor, Tensor]] | None:
    """Numba's SSIM with its gradient (`cpu.ssim`), if numba is installed. None: kornia must compare these tensors."""
    kinds = {(value.device.type, value.dtype) for value in tensors}
    device, dtype = kinds.pop()
    if kinds or device != "cpu" or not choose("auto", device, dtype).projects:  # on a CPU only numba's engine projects
        return None
    from .cpu.ssim import mean_ssim

    return mean_ssim
