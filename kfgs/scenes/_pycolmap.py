"""The door to pycolmap: imported late, after Pillow, quietly, and with one kind of error.

Pillow's C module must be loaded **before** pycolmap: in the other order (pycolmap 4.2.1, Pillow 13.0.0, Linux wheels)
the first PNG that Pillow writes corrupts the heap and aborts the process ("corrupted size vs. prev_size" in
ImagingZipEncode). So Pillow, where it is installed, is loaded with this file, which every import of `kfgs.scenes` reads.
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

# What pycolmap raises on files that it cannot make sense of (a failed CHECK is a ValueError, a missing id an IndexError).
FAILURES = (ValueError, IndexError, KeyError, RuntimeError, MemoryError, OSError)

_FATAL = 3  # glog's levels: 0 info, 1 warning, 2 error, 3 fatal


def import_pycolmap() -> Any:
    """The module, loaded at the first call.

    Raises:
        ImportError: if it is not installed, with the install line.
    """
    before = signal.getsignal(signal.SIGTERM)
    try:
        import pycolmap
    except ImportError as error:
        raise ImportError(
            "pycolmap: needed to estimate cameras, to undistort and to align, but it cannot be imported; "
            f"run `pip install 'pycolmap>=4.0'` ({error})"
        ) from error
    # Its log library prints a stack for a process that is asked to end; what was there before does not.
    if before is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)
    return pycolmap


@contextlib.contextmanager
def quiet_pycolmap() -> Iterator[Any]:
    """Pycolmap with its log silenced (what fails comes as an exception); the log level is put back afterwards."""
    pycolmap = import_pycolmap()
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = _FATAL
    try:
        yield pycolmap
    finally:
        pycolmap.logging.minloglevel = before


@contextlib.contextmanager
def wrapped(what: str, advice: str) -> Iterator[None]:
    """Turn pycolmap's exceptions into a SceneError that begins with `what` and ends with `advice`."""
    try:
        yield
    except SceneError:
        raise
    except FAILURES as error:
        said = str(error).strip().splitlines()
        raise SceneError(f"{what} ({type(error).__name__}: {said[0] if said else 'no text'}); {advice}") from error
