"""The decorator of the explorer's public methods: one thread at a time, and only while the explorer is open."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from threading import RLock
from typing import Concatenate, ParamSpec, Protocol, TypeVar


class Closable(Protocol):
    """An object with a lock that can be closed."""

    lock: RLock  # type: ignore[valid-type]

    @property
    def closed(self) -> bool:
        """Whether it is closed."""


Owner = TypeVar("Owner", bound=Closable)
Given = ParamSpec("Given")
Result = TypeVar("Result")


def while_open(method: Callable[Concatenate[Owner, Given], Result]) -> Callable[Concatenate[Owner, Given], Result]:
    """Let a method wait for those of other threads, and refuse a closed explorer before anything changes.

    Raises:
        RuntimeError: if the explorer is closed.
    """

    @wraps(method)
    def act(self: Owner, /, *args: Given.args, **options: Given.kwargs) -> Result:
        with self.lock:
            if self.closed:
                raise RuntimeError(
                    f"explorer: expected an open one for {method.__name__}, got one that is closed; make another with "
                    "explore(...) or Explorer(explorer.state)"
                )
            return method(self, *args, **options)

    return act
