"""Locks on files. The system releases them when their process ends, however it ends."""

from __future__ import annotations

import os
import shlex
import socket
import stat
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows: two processes that write to one place are not noticed there
    fcntl = None  # type: ignore[assignment]

MARK = b"process "  # begins what a lock file says
LONGEST = 300  # characters of a lock file that are read and shown


class InUseError(ValueError):
    """Another process works in a folder; the message says which."""


def open_lock(file: Path, *, new: bool = True) -> int:
    """Open a lock file for reading and writing; `new` makes it if it is missing.

    Raises:
        ValueError: if a link, a pipe or a device is there.
        OSError: if it cannot be opened.
    """
    harmless = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)  # Windows has neither
    handle = None
    if not file.is_symlink():
        handle = os.open(file, os.O_RDWR | harmless | (os.O_CREAT if new else 0), 0o666)
        if stat.S_ISREG(os.fstat(handle).st_mode):
            return handle
        os.close(handle)
    raise _no_lock(file, "a link" if handle is None else "a pipe or a device")


def _no_lock(file: Path, got: str) -> ValueError:
    return ValueError(f"{file}: expected a lock file of kfgs or nothing there, got {got}; delete it")


def try_lock(handle: int, *, shared: bool = False) -> bool | None:
    """Lock an open file until it is closed. False if another process or call holds it; None if there are no locks here."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(handle, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return None
    return True


def is_locked(file: Path) -> bool | None:
    """Whether a process holds a lock; None if that is unknown: the file is missing or cannot be read, or there are no locks."""
    if fcntl is None or file.is_symlink():
        return None
    try:
        handle = os.open(file, os.O_RDONLY | os.O_NONBLOCK)
    except OSError:
        return None
    try:
        free = try_lock(handle, shared=True)
    finally:
        os.close(handle)
    return None if free is None else not free


@contextmanager
def locked(folder: Path, name: str) -> Iterator[None]:
    """Keep other processes from working in a folder; it is made if it does not exist.

    Args:
        folder: the folder.
        name: of the lock file in it, which says who holds the lock. It stays: if it were removed, two processes could
            hold locks of the same name.

    Raises:
        InUseError: if another process holds the lock; the message says which.
        ValueError: if a link or another file is in place of the lock file.
        OSError: if the folder cannot be made or written to; the message says so.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = open_lock(folder / name)
    except OSError as error:
        raise type(error)(
            f"{folder}: expected a folder that can be written to, got one that cannot ({error.strerror}); choose another"
        ) from error
    try:
        there = os.read(handle, LONGEST)
        if try_lock(handle) is False:
            holder = ascii(there.decode(errors="replace").strip())[1:-1] or "another process"
            raise InUseError(
                f"{folder}: expected a folder that no other process writes to, got one in use by {holder}; wait until that "
                "process has ended, or name another folder"
            )
        if there and not there.startswith(MARK):  # somebody else's file, perhaps linked from elsewhere
            raise _no_lock(folder / name, "another file")
        os.lseek(handle, 0, os.SEEK_SET)
        os.truncate(handle, 0)
        command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])[:200]
        holder = f"{os.getpid()} of {socket.gethostname()} ({command}, since {time.ctime()})"
        os.write(handle, MARK + holder.encode())
        yield
    finally:
        os.close(handle)
