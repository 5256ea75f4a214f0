"""Names of views: their order and what features and labels are found by."""

from __future__ import annotations

import re
from pathlib import PurePosixPath


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """A sort key under which rgb_5 comes before rgb_10.

    Example:
        >>> sorted(["rgb_10", "rgb_5"], key=natural_key)
        ['rgb_5', 'rgb_10']
    """
    parts = re.split(r"([0-9]+)", name)
    return [(0, int(part), part) if i % 2 else (1, 0, part) for i, part in enumerate(parts)]


def file_stem(name: str) -> str:
    """A view's name without its suffix, folders kept.

    Example:
        >>> file_stem("rgb_5.png"), file_stem("train/r_0.png")
        ('rgb_5', 'train/r_0')
    """
    path = PurePosixPath(name)
    return str(path.with_suffix("")) if path.name else name  # "/" and "." have no suffix to take


def some(names: list[str], count: int = 5) -> str:
    """The first few of a list of names, for a message."""
    return ", ".join(names[:count]) + (f" and {len(names) - count} more" if len(names) > count else "")
