"""From a class name to its label, with a helpful refusal."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

SHOWN = 20  # names listed in a message


def class_index(name: str, names: Sequence[str]) -> int:
    """The label of a class: its place in `names`.

    Raises:
        ValueError: if there is no such class; the message offers the nearest names, whatever their case.

    Example:
        >>> class_index("chair", ["wall", "chair"])
        1
    """
    if name in names:
        return list(names).index(name)
    if not names:
        raise ValueError(
            f"class: expected class names to look {name!r} up in, got none; pass the names or use an index"
        )
    lower = {one.lower(): one for one in names}
    near = [lower[match] for match in difflib.get_close_matches(name.lower(), lower, n=3, cutoff=0.6)]
    near += [one for one in names if name and name.lower() in one.lower() and one not in near][:3]
    listed = ", ".join(names[:SHOWN]) + (f" and {len(names) - SHOWN} more" if len(names) > SHOWN else "")
    hint = f"did you mean {' or '.join(map(repr, near))}?" if near else "add its embedding to the classes"
    raise ValueError(f"class: expected one of {listed}, got {name!r}; {hint}")
