"""Ctrl-C on the command line: one line and exit code 130, from the first import to the end of the process."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

IMPORTS = ("<frozen importlib._bootstrap>", "_find_and_load")


def end_at_once(*_: Any) -> None:
    """End the process without a clean-up, where no exception may pass, as a kill does."""
    with suppress(OSError):
        os.write(2, b"interrupted\n")  # a Python stream may be in use
    os._exit(130)  # as shells count it: 128 + SIGINT


@contextmanager
def interruptible() -> Iterator[None]:
    """Make Ctrl-C and SIGTERM a KeyboardInterrupt in the block; while a module loads, end the process at once.

    A C++ module that loads (torch, numpy, pycolmap) aborts, or fails with an ImportError, when Python raises in it.
    """
    usual = signal.getsignal(signal.SIGINT) in (signal.default_int_handler, end_at_once)
    if not usual or threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        came.append(number)
        while frame is not None:
            if (frame.f_code.co_filename, frame.f_code.co_name) == IMPORTS:
                end_at_once()
            frame = frame.f_back
        raise KeyboardInterrupt

    stops = (signal.SIGINT, signal.SIGTERM) if signal.getsignal(signal.SIGTERM) is signal.SIG_DFL else (signal.SIGINT,)
    before = {number: signal.signal(number, interrupt) for number in stops}
    try:
        yield
    except Exception as error:
        if came:  # a library made it of the KeyboardInterrupt
            raise KeyboardInterrupt from error
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
