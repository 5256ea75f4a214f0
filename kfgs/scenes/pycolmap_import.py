"""Import pycolmap late, after Pillow and without its log; turn its exceptions into a SceneError.

Pillow's C module must be loaded **before** pycolmap. In the other order (pycolmap 4.2.1, Pillow 13.0.0, Linux wheels)
the first PNG that Pillow writes corrupts the heap and aborts the process ("corrupted size vs. prev_size" in
ImagingZipEncode). So this file, which every import of `kfgs.scenes` reads, loads Pillow if it is installed.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from typing import Any

from .files import SceneError

with contextlib.suppress(ImportError):
    import PIL.Image  # noqa: F401  # see above: the order matters

# Exceptions of pycolmap for unusable input (a failed CHECK is a ValueError, a missing id an IndexError).
FAILURES = (ValueError, IndexError, KeyError, RuntimeError, MemoryError, OSError)

_FATAL = 3  # glog's levels: 0 info, 1 warning, 2 error, 3 fatal


def import_pycolmap() -> Any:
    """The module, loaded at the first call. Raises an ImportError if it is not installed, with the install line."""
    before = signal.getsignal(signal.SIGTERM)
    try:
        with _late_interrupt():
            import pycolmap
    except ImportError as error:
        raise ImportError(
            "pycolmap: needed to estimate cameras, to undistort and to align, but it cannot be imported; "
            f"run `pip install 'pycolmap>=4.0'` ({error})"
        ) from error
    # pycolmap's log library prints a stack when the process receives SIGTERM; put the earlier handler back.
    if before is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)
    return pycolmap


@contextlib.contextmanager
def _late_interrupt() -> Iterator[None]:
    """Deliver Ctrl-C only after the block: inside a C++ module that loads, it would become an ImportError or a crash."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL if before is None else before)
        if came:
            signal.raise_signal(signal.SIGINT)


@contextlib.contextmanager
def quiet_pycolmap() -> Iterator[Any]:
    """Pycolmap without its log: failures come as exceptions. The log level is restored afterwards."""
    pycolmap = import_pycolmap()
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = _FATAL
    try:
        yield pycolmap
    finally:
        pycolmap.logging.minloglevel = before


@contextlib.contextmanager
def scene_errors(what: str, advice: str) -> Iterator[None]:
    """Turn pycolmap's exceptions into a SceneError that begins with `what` and ends with `advice`."""
    try:
        yield
    except SceneError:
        raise
    except FAILURES as error:
        lines = str(error).strip().splitlines()
        raise SceneError(f"{what} ({type(error).__name__}: {lines[0] if lines else 'no text'}); {advice}") from error
