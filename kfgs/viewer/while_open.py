"""Decorator for the explorer's public methods: takes the lock, and raises if the explorer is closed."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from threading import RLock
from typing import Concatenate, ParamSpec, Protocol, TypeVar


class Closable(Protocol):
    """Something with a lock that can be closed."""

    lock: RLock  # type: ignore[valid-type]

    @property
    def closed(self) -> bool:
        """Whether it is closed."""


Owner = TypeVar("Owner", bound=Closable)
Given = ParamSpec("Given")
Result = TypeVar("Result")


def while_open(method: Callable[Concatenate[Owner, Given], Result]) -> Callable[Concatenate[Owner, Given], Result]:
    """Run a method under the explorer's lock; a RuntimeError if the explorer is closed."""

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
