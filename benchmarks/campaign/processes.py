"""Run one command of kfgs in a forked process: to its end, killed at an event, killed or told to end at a time.

The parent has imported kfgs but done nothing with it, so that a process starts in milliseconds.
"""

from __future__ import annotations

import os
import re
import signal
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
CHANGES = re.compile(r"os\.(rename|remove|mkdir|rmdir|link|symlink|truncate|chmod|utime)|fcntl\.|shutil\.|tempfile\.")
LONGEST = 900.0  # seconds until a command counts as hanging: the first one compiles, beside other programs

Work = Callable[[], Any]


@dataclass(frozen=True)
class Ended:
    """How a process ended."""

    code: int
    """Exit code; -9 if it was killed."""
    events: int
    """Changes of the file system that it began."""
    said: str
    """Its stdout and stderr."""
    seconds: float
    hung: bool = False


class Process:
    """A forked process that works in a folder.

    Args:
        work: what it does; returns the exit code, or None for 0.
        folder: where, as the current folder; its output goes to a file beside the folder.
        kill_at: the number of the event, from 0, before which it is killed; None: never.
        limit: largest file in bytes that it may write; None: any.
    """

    def __init__(self, work: Work, folder: Path, *, kill_at: int | None = None, limit: int | None = None) -> None:
        self.began = time.monotonic()
        self.log = folder.with_name(f"{folder.name}.{time.monotonic_ns()}.log")
        self._counted, counts = os.pipe()
        sys.stdout.flush()
        sys.stderr.flush()
        self.pid = os.fork()
        if self.pid == 0:
            code = 70
            try:
                _count_events(counts, kill_at, self.log)
                _prepare(folder, self.log, limit)
                code = work() or 0
            except SystemExit as error:
                code = error.code if isinstance(error.code, int) else 1
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(code)
        os.close(counts)

    def signal(self, number: int) -> None:
        """Send a signal, if it still runs."""
        os.kill(self.pid, number)

    def ready(self) -> bool:
        """Whether the command has begun: signals are handled as in a process of its own."""
        return self.log.exists()

    def running(self) -> bool:
        """Whether it still runs. It is not waited for: `wait` does."""
        return os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None

    def wait(self) -> Ended:
        """Wait for its end; a process that hangs is killed."""
        hung = False
        while self.running():
            if time.monotonic() - self.began > LONGEST:
                hung = True
                os.kill(self.pid, signal.SIGKILL)
                break
            time.sleep(0.002)
        _, status = os.waitpid(self.pid, 0)
        with os.fdopen(self._counted, "rb") as counted:
            events = len(counted.read())
        said = self.log.read_text(errors="replace") if self.log.exists() else ""
        self.log.unlink(missing_ok=True)
        return Ended(os.waitstatus_to_exitcode(status), events, said, time.monotonic() - self.began, hung)


def _prepare(folder: Path, log: Path, limit: int | None) -> None:
    import resource

    from kfgs._interrupts import end_at_once

    os.setpgid(0, 0)
    os.chdir(folder)
    signal.signal(signal.SIGINT, end_at_once)  # the first thing that `kfgs` does
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    out = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(out, 1)
    os.dup2(out, 2)
    if limit is not None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))


def _count_events(counts: int, kill_at: int | None, log: Path) -> None:
    """Write a byte for each change of the file system that begins, and kill this process before the chosen one.

    Opening the log is none: when it is there, signals may come.
    """
    seen = 0
    os.set_blocking(counts, False)  # after 64 KiB further events are not counted

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal seen
        if event == "open":
            path, _, flags = arguments
            if not isinstance(flags, int) or not flags & WRITES or str(path).startswith(("/dev/", "/proc/", str(log))):
                return
        elif not CHANGES.match(event):
            return
        seen += 1
        if kill_at is not None and seen == kill_at + 1:
            os.kill(os.getpid(), signal.SIGKILL)
        with suppress(BlockingIOError):
            os.write(counts, b".")

    sys.addaudithook(hook)


def command(*words: str) -> Work:
    """`kfgs` with these words, as a shell starts it."""
    from kfgs.__main__ import run

    def work() -> int:
        sys.argv = ["kfgs", *words]
        return run()

    return work
