"""Import pycolmap late, after Pillow and without its log; turn its exceptions into a SceneError.

Pillow's C module must be loaded **before** pycolmap. In the other order (pycolmap 4.2.1, Pillow 13.0.0, Linux wheels)
the first PNG that Pillow writes corrupts the heap and aborts the process. So this file loads Pillow.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import PIL.Image  # noqa: F401  # see above: the order matters

from .files import SceneError

# Exceptions of pycolmap for unusable input (a failed CHECK is a ValueError, a missing id an IndexError).
FAILURES = (ValueError, IndexError, KeyError, RuntimeError, MemoryError, OSError)


def import_pycolmap() -> Any:
    """The module, loaded at the first call. Raises an ImportError if it is not installed, with the install line."""
    before = signal.getsignal(signal.SIGTERM)
    try:
        import pycolmap
    except ImportError as error:
        raise ImportError(
            "pycolmap: needed to estimate cameras, but it cannot be imported; run `pip install 'pycolmap>=4.0'` "
            f"({error})"
        ) from error
    if before is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)  # pycolmap's log library would print a stack
    return pycolmap


@contextmanager
def quiet_pycolmap(what: str = "pycolmap: expected input that it can use", advice: str = "check it") -> Iterator[Any]:
    """Pycolmap without its log. Its failures become a SceneError that begins with `what` and ends with `advice`."""
    pycolmap = import_pycolmap()
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 3  # fatal
    try:
        yield pycolmap
    except SceneError:
        raise
    except FAILURES as error:
        lines = str(error).strip().splitlines()
        raise SceneError(f"{what} ({type(error).__name__}: {lines[0] if lines else 'no text'}); {advice}") from error
    finally:
        pycolmap.logging.minloglevel = before
