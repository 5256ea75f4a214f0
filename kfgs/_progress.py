"""What `progress` is in every function that trains: a bar, or a function that is called with each row of the history."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

Progress = bool | Callable[[dict[str, Any]], None]
"""True shows a bar, a function is called with each new row, False does neither."""


def as_progress(progress: Any) -> Progress:
    """A function as it is, a truth value as a bool."""
    return progress if callable(progress) else bool(progress)


def as_bar(progress: Any) -> bool:
    """`as_progress` where there is no history to call a function with (TypeError)."""
    if callable(progress):
        raise TypeError("progress: expected True or False, got a function; there are no rows to call it with")
    return bool(progress)
