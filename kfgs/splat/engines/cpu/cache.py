"""Compiled kernels that are kept on disk, and compiled again when any file of the engines has changed."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any
from zlib import crc32

from numba import njit
from numba.core import event
from numba.core.caching import IndexDataCacheFile

from kfgs._notes import Wait, tell

_HERE = Path(__file__).parent
_FILES = [file for folder in (_HERE, *_HERE.parents[:2]) for file in sorted(folder.glob("*.py"))]  # sh.py is above
SOURCES = crc32(b"".join(file.read_bytes() for file in _FILES))


_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}


def inner_njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit` for functions that only kernels call.

    A call from Python ends the process: what numba compiles for such a call would be one more copy of the function, and of
    all that it inlines.
    """
    return njit(no_cpython_wrapper=True, **_OPTIONS, **options)  # type: ignore[no-any-return]


def cached_njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit(cache=True)` for kernels that call functions of other files.

    Numba's cache looks only at the date of the kernel's own file. If a file that it inlines changes, numba would use the old
    code. It offers no way to add to its key, so this sets a private attribute. If no folder for the cache can be written,
    each process compiles the kernel for itself.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            kernel = njit(cache=True, **_OPTIONS, **options)(function)
            index = kernel._cache._cache_file
            index.__class__, index._source_stamp = _Kept, (index._source_stamp, SOURCES)
        except (RuntimeError, AttributeError):  # no folder can be written, or another version of numba
            return njit(**_OPTIONS, **options)(function)
        return kernel

    return decorate


class _Kept(IndexDataCacheFile):  # type: ignore[misc]
    """A kernel's files in the cache: those that cannot be read are made again, and those that cannot be written are missed.

    Numba writes its index before the kernel. If the process is killed between them, the index leads to the code of an
    earlier kernel, so the code says what it is of.
    """

    said = False

    def _load_index(self) -> Any:
        try:
            return super()._load_index()
        except Exception:  # cut off, or of another user
            return {}

    def load(self, key: Any) -> Any:
        try:
            made_for, data = super().load(key)
        except Exception:  # there is none (None cannot be unpacked), or it is cut off
            return None
        return data if made_for == (self._source_stamp, key) else None

    def save(self, key: Any, data: Any) -> None:
        try:
            super().save(key, ((self._source_stamp, key), data))
        except OSError as error:
            if not _Kept.said:
                _Kept.said = True
                warnings.warn(
                    f"{self._cache_path}: expected space for compiled kernels, got {error.strerror or error}; every process "
                    "will compile them again, for a minute or two. Free some space, or set NUMBA_CACHE_DIR to another folder",
                    RuntimeWarning,
                    stacklevel=2,
                )


COMPILING = "compiling kernels of the CPU engine (seconds each, a minute or two in all; each only once on this machine)"


class _Compiling(event.Listener):
    """Tells when one of kfgs's kernels is about to be compiled."""

    def on_start(self, event: event.Event) -> None:
        function = getattr(event.data["dispatcher"], "py_func", None)
        if (getattr(function, "__module__", None) or "").startswith("kfgs."):
            tell(Wait(COMPILING))

    def on_end(self, event: event.Event) -> None:
        pass


event.register("numba:compile", _Compiling())
