"""Errors of writing a file: messages name the output that was asked for, not the hidden file that was written."""

from __future__ import annotations

import errno
import math
import os
import re
import shutil
from contextlib import suppress
from pathlib import Path

FULL = (errno.ENOSPC, errno.EDQUOT)
UNNAMED = (*FULL, errno.EIO, errno.EFBIG, errno.EROFS)  # errors of writing, which Python raises without a file
SHORT = "requested and"  # in the message of numpy
LEAST = 1 << 14  # bytes: a disk with less is full


class FullDiskError(OSError):
    """The disk has no space for an output; the message names the file or folder that was asked for."""


def retold(error: Exception, place: Path, target: Path, *, gone: bool = False) -> OSError | None:
    """An error of writing as one that names what was asked for; None if it can be raised as it is.

    Args:
        error: any error of the writer, also one of another kind.
        place: where it wrote, in a hidden folder.
        target: what was asked for.
        gone: whether the hidden folder is not there any more.
    """
    text, told = str(error), isinstance(error, FullDiskError)
    if isinstance(error, ValueError | TypeError | LookupError) or (told and str(place) not in text):
        return None
    rust = re.search(r"\(os error (\d+)\)", text)  # of safetensors
    code = int(rust[1]) if rust else getattr(error, "errno", None)
    if code == errno.ENOENT and gone:
        return FileNotFoundError(
            f"{target}: expected its folder to stay while it is written, but something else deleted or moved it; start again"
        )
    free = _free(place)
    most = _largest_file()
    if code == errno.EFBIG or (SHORT in text and LEAST < most < free):
        return FullDiskError(
            f"{target}: expected to write it whole, but files may have at most {most:,} bytes here; raise that limit (ulimit -f)"
        )
    if told or code in FULL or SHORT in text or free < LEAST:
        return FullDiskError(
            f"{target}: expected space on the disk to write it, got {free:,} bytes free; free some, or choose another disk"
        )
    unnamed = code in UNNAMED and getattr(error, "filename", None) is None
    if code is not None and (unnamed or str(place) in text):
        return OSError(code, os.strerror(code), str(target))
    return None


def _largest_file() -> float:
    """The most bytes that the system lets this process write to a file."""
    with suppress(ImportError):  # Windows
        import resource

        soft = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
        return math.inf if soft == resource.RLIM_INFINITY else soft
    return math.inf


def _free(place: Path) -> float:
    """Bytes that are free on the disk of a folder; infinitely many if the system does not say."""
    with suppress(OSError):
        return shutil.disk_usage(next(folder for folder in (place, *place.parents) if folder.is_dir())).free
    return math.inf
