"""Locks on files. The system releases them when their process ends, however it ends."""

from __future__ import annotations

import os
import shlex
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows: two processes that write to one place are not noticed there
    fcntl = None  # type: ignore[assignment]

LONGEST = 300  # characters of a lock file that are read and shown


class InUseError(ValueError):
    """Another process works in a folder; the message says which."""


def try_lock(handle: int) -> bool | None:
    """Lock an open file until it is closed. False if another process or call holds it; None if there are no locks here."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return None
    return True


@contextmanager
def locked(folder: Path, name: str) -> Iterator[None]:
    """Keep other processes from working in a folder; it is made if it does not exist.

    Args:
        folder: the folder.
        name: of the lock file in it, which says who holds the lock. It stays: if it were removed, two processes could
            hold locks of the same name.

    Raises:
        InUseError: if another process holds the lock; the message says which.
        OSError: if the folder cannot be made or written to; the message says so.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder / name, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise type(error)(
            f"folder: expected a folder that can be written to, got {folder} ({error.strerror}); choose another"
        ) from error
    try:
        if try_lock(handle) is False:
            holder = ascii(os.read(handle, LONGEST).decode(errors="replace").strip())[1:-1] or "another process"
            raise InUseError(
                f"folder: expected one that no other process writes to, got {folder}, which is in use by {holder}; wait "
                "until that process has ended, or name another folder"
            )
        os.truncate(handle, 0)
        command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])[:200]
        os.write(handle, f"process {os.getpid()} of {socket.gethostname()} ({command}, since {time.ctime()})".encode())
        yield
    finally:
        os.close(handle)
