"""Which engines there are, what they need, and where they run."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from threading import RLock
from types import ModuleType
from typing import NamedTuple

import torch
from torch import Tensor

from ..._check import check_choice


class _Entry(NamedTuple):
    module: str
    needs: str  # the package it imports
    install: str  # how to get that


_ENGINES = {
    "triton": _Entry("kfgs.splat.engines.triton.engine", "triton", "pip install triton"),
    "numba": _Entry("kfgs.splat.engines.cpu.engine", "numba", "pip install numba"),
    "reference": _Entry("kfgs.splat.engines.reference", "torch", "pip install torch"),
}
"""In order of preference: `engine="auto"` takes the first that knows the device and can be imported."""


def available_engines(device: str | None = None) -> list[str]:
    """Names of the engines whose packages are installed, the fastest first.

    Args:
        device: "cpu" or "cuda": only the engines for that device, which are imported to find out. None: all engines,
            and nothing is imported.
    """
    names = [name for name, entry in _ENGINES.items() if find_spec(entry.needs) and find_spec(entry.module)]
    return names if device is None else [name for name in names if _serves(name, device)]


_FLAGS = RLock()  # guards the flags of dlopen; an engine may load another


@cache
def load(name: str) -> ModuleType:
    """The engine's module.

    Raises:
        ImportError: if the package that it needs cannot be used, with the line that installs it.
    """
    entry = _ENGINES[name]
    try:
        with _own_symbols():
            return import_module(entry.module)
    except ImportError as error:
        raise ImportError(
            f"engine: expected {entry.needs} for engine {name!r}, but it cannot be imported ({error}); "
            f"install it with `{entry.install}`, or choose one of {available_engines()}"
        ) from error


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


def choose(engine: str, device: str, dtype: torch.dtype) -> str:
    """The engine's name for tensors of a device and a dtype: the fastest one for them if it is "auto".

    Raises:
        ValueError: if there is no such engine, or it does not run on the device or in the dtype.
        ImportError: if the named engine's package is missing.
    """
    return _choose(engine, device, dtype)


@cache
def _choose(engine: str, device: str, dtype: torch.dtype) -> str:
    if engine == "auto":
        known = (name for name in available_engines(device) if dtype in load(name).DTYPES)
        return next(known, "reference")  # which says what it wants instead
    check_choice("engine", engine, ["auto", *_ENGINES])
    devices = load(engine).devices()
    if device not in devices:
        raise ValueError(
            f"engine: expected one that runs on {device} (from means2d), got {engine!r} for {', '.join(devices)}; "
            "use engine='auto'"
        )
    if dtype not in load(engine).DTYPES:
        kinds = " or ".join(map(str, load(engine).DTYPES))
        raise ValueError(
            f"engine: expected one for {dtype} (from means2d), got {engine!r} for {kinds}; convert the Gaussians with "
            ".to(), or use engine='auto'"
        )
    return engine


def choose_compiled(engine: str, function: str, name: str, *tensors: Tensor) -> str | None:
    """The engine that projects or bins these tensors itself. None: kornia's and torch's functions do it.

    Args:
        engine: a name, or "auto".
        function: "project" or "bin".
        name: of the tensors in a message.
        tensors: the data.

    Raises:
        ValueError: as `choose`, and if a named engine gets tensors that are not all float32 or all float64.
        ImportError: if the named engine's package is missing.
    """
    dtype = tensors[0].dtype if engine == "auto" else torch.float32  # a named engine's errors are raised below
    chosen = choose(engine, tensors[0].device.type, dtype)
    if not offers(chosen, function):
        return None
    kinds = {value.dtype for value in tensors}
    known = len(kinds) == 1 and kinds <= {torch.float32, torch.float64}
    if engine != "auto" and not known:
        raise ValueError(
            f"{name}: expected all in float32 or all in float64 for engine {engine!r}, got "
            f"{', '.join(sorted(map(str, kinds)))}; convert them with .to(torch.float32)"
        )
    return chosen if known else None


def offers(name: str, function: str) -> bool:
    """Whether an engine has a function that is optional."""
    return hasattr(load(name), function)


# torch.compiler.assume_constant_result sets the same attribute, but imports the compiler.
choose._dynamo_marked_constant = True  # type: ignore[attr-defined]
offers._dynamo_marked_constant = True  # type: ignore[attr-defined]


def _serves(name: str, device: str) -> bool:
    """Whether "auto" may take an engine for a device: not if it runs there only for tests."""
    try:
        engine = load(name)
        return device in engine.devices() and device not in getattr(engine, "PROOFS", ())
    except ImportError:  # installed, but broken on this machine
        return False
