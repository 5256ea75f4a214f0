"""What makes a method of the explorer a verb: it works only while the explorer is open, for one thread at a time."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Concatenate, ParamSpec, TypeVar

if TYPE_CHECKING:
    from .explorer import Explorer

Given = ParamSpec("Given")
Result = TypeVar("Result")


def verb(
    method: Callable[Concatenate[Explorer, Given], Result],
) -> Callable[Concatenate[Explorer, Given], Result]:
    """Let a method wait for those of other threads, and refuse a closed explorer before anything changes.

    Raises:
        RuntimeError: if the explorer is closed.
    """

    @wraps(method)
    def act(self: Explorer, /, *args: Given.args, **options: Given.kwargs) -> Result:
        with self.lock:
            if self.closed:
                raise RuntimeError(
                    f"explorer: expected an open one for {method.__name__}, got one that is closed; make another with "
                    "explore(...) or Explorer(explorer.state)"
                )
            return method(self, *args, **options)

    return act
