"""What `progress` is in every function that trains: a bar, or a function that is called with each row of the history."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

Progress = bool | Callable[[dict[str, Any]], None]
"""True shows a bar, a function is called with each new row, False does neither."""


def as_progress(progress: Any) -> Progress:
    """A function as it is, a truth value as a bool; a TypeError for anything else."""
    if callable(progress):
        return progress
    if not isinstance(progress, int | np.bool_ | None):
        raise TypeError(
            f"progress: expected True, False or a function, got {progress!r:.60}; True shows a bar, a function gets each row"
        )
    return bool(progress)


def as_bar(progress: Any) -> bool:
    """`as_progress` where there is no history to call a function with (TypeError)."""
    if callable(progress):
        raise TypeError("progress: expected True or False, got a function; there are no rows to call it with")
    return bool(as_progress(progress))
