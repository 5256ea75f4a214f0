"""Ctrl-C on the command line: one line and exit code 130, from the first import to the end of the process."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

CODE = 130  # as shells count it: 128 + SIGINT
IMPORTS = ("<frozen importlib._bootstrap>", "_find_and_load")


def end_at_once(*_: Any) -> None:
    """End the process without a clean-up, where no exception may pass; the next writer sweeps, as after a kill."""
    with suppress(OSError):
        os.write(2, b"interrupted\n")  # a Python stream may be in use
    os._exit(CODE)


@contextmanager
def interruptible() -> Iterator[None]:
    """Make Ctrl-C and SIGTERM a KeyboardInterrupt in the block, except where one would be lost or become another error.

    A C++ module that loads (torch, numpy, pycolmap) ends the process with SIGABRT, or with an ImportError, when Python raises
    in it. Python itself prints and forgets an exception in `__del__`. There the process ends at once.
    """
    usual = (signal.default_int_handler, end_at_once)
    before = signal.getsignal(signal.SIGINT)
    if before not in usual or threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    told = sys.unraisablehook

    def interrupt(number: int, frame: FrameType | None) -> None:
        came.append(number)
        if _imports(frame):
            end_at_once()
        signal.default_int_handler(number, frame)

    def forgotten(error: Any) -> None:
        if issubclass(error.exc_type, KeyboardInterrupt):
            end_at_once()
        told(error)

    signal.signal(signal.SIGINT, interrupt)
    ended = signal.getsignal(signal.SIGTERM)
    asked = ended is signal.SIG_DFL
    if asked:
        signal.signal(signal.SIGTERM, interrupt)
    sys.unraisablehook = forgotten
    try:
        yield
    except Exception as error:
        if came:  # a library made it of the KeyboardInterrupt
            raise KeyboardInterrupt from error
        raise
    finally:
        sys.unraisablehook = told
        signal.signal(signal.SIGINT, before)
        if asked:
            signal.signal(signal.SIGTERM, ended)


def _imports(frame: FrameType | None) -> bool:
    """Whether a module is loaded at this point of the program."""
    while frame is not None:
        if (frame.f_code.co_filename, frame.f_code.co_name) == IMPORTS:
            return True
        frame = frame.f_back
    return False
