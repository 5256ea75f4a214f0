"""What an error message must tell, without pinning its prose."""

import re
from collections.abc import Callable

import pytest


def tells(*parts: object) -> str:
    """A pattern for `match=`: the message holds every part, in any order: the argument's name, what came, what to do."""
    return "(?s)" + "".join(f"(?=.*{re.escape(str(part))})" for part in parts)


def refused(act: Callable[[], object], *parts: object, error: type[Exception] = ValueError) -> str:
    """A call raises an error whose message, which comes back, tells every part."""
    with pytest.raises(error, match=tells(*parts)) as caught:
        act()
    return str(caught.value)
