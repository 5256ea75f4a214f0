"""Compiled kernels that are kept on disk, and compiled again when any of the engine's files has changed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any
from zlib import crc32

from numba import njit

_HERE = Path(__file__).parent
_FILES = [file for folder in (_HERE, _HERE.parent) for file in sorted(folder.glob("*.py"))]  # contract.py is above
SOURCES = crc32(b"".join(file.read_bytes() for file in _FILES))


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """As `numba.njit(cache=True)`, for kernels that call into other files.

    Numba's cache looks at the time of a kernel's own file alone, and would go on with what it inlined from another one.
    It has no hook for this, hence the private attributes. An argument with the sources' number as its default would do,
    too, but such calls of a kernel from the cache are resolved in Python, at a tenth of a millisecond each. Where no
    place for the cache can be written to, the kernel is compiled once per process.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            kernel = njit(cache=True, **options)(function)
            index = kernel._cache._cache_file
            index._source_stamp = index._source_stamp, SOURCES
        except (RuntimeError, AttributeError):  # no place to write to, or another numba
            return njit(**options)(function)
        return kernel

    return decorate
