"""Compiled kernels that are kept on disk, and compiled again when any file of the engines has changed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any
from zlib import crc32

from numba import njit
from numba.core import event

from kfgs._compiling import tell_compiling

_HERE = Path(__file__).parent
_FILES = [file for folder in (_HERE, _HERE.parent) for file in sorted(folder.glob("*.py"))]  # contract.py is above
SOURCES = crc32(b"".join(file.read_bytes() for file in _FILES))


def cached_njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit(cache=True)` for kernels that call functions of other files.

    Numba's cache looks only at the date of the kernel's own file. If a file that it inlines changes, numba would go on
    with the old code. It offers no way to add to its key, so this sets a private attribute. (A default argument that
    holds the checksum would work too, but then Python resolves every call of a cached kernel, in 0.1 ms.) If no folder
    for the cache can be written, each process compiles the kernel for itself.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            kernel = njit(cache=True, **options)(function)
            index = kernel._cache._cache_file
            index._source_stamp = index._source_stamp, SOURCES
        except (RuntimeError, AttributeError):  # no folder can be written, or another version of numba
            return njit(**options)(function)
        return kernel

    return decorate


class _Compiling(event.Listener):
    """Tells when one of kfgs's kernels is about to be compiled."""

    def on_start(self, event: event.Event) -> None:
        function = getattr(event.data["dispatcher"], "py_func", None)
        if (getattr(function, "__module__", None) or "").startswith("kfgs."):
            tell_compiling()

    def on_end(self, event: event.Event) -> None:
        pass


event.register("numba:compile", _Compiling())
