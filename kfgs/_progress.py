"""What `progress` is in every function that trains: a bar, or a function that is called with each row of the history."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

Progress = bool | Callable[[dict[str, Any]], None]
"""True shows a bar, a function is called with each new row, False does neither."""
