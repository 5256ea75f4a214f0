"""Look up the labels of a class name; the error for an unknown name offers similar names."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

SHOWN = 20  # names listed in a message
TAKE = "take one of these classes"


def class_index(name: str, names: Sequence[str], otherwise: str = TAKE) -> int:
    """The label of a class: its place in `names`, found as `class_indices` does; `otherwise` is its advice.

    Raises:
        ValueError: if the name is unknown (the message offers the nearest names), or several labels have it.

    Example:
        >>> class_index("chair", ["wall", "chair"])
        1
    """
    found = class_indices(name, names, otherwise)
    if len(found) > 1:
        raise ValueError(
            f"class: expected one class called {name!r}, got {len(found)} (labels {', '.join(map(str, found))}); "
            "rename all but one, or ask for one by its index"
        )
    return found[0]


def class_indices(name: str, names: Sequence[str], otherwise: str = TAKE) -> tuple[int, ...]:
    """The labels of a class, ascending. There are several if several classes have the same name.

    A name is looked up exactly, then without regard to case, if only one spelling fits. `otherwise` is the advice about a name
    that is like none.

    Raises:
        ValueError: if the name is unknown; the message offers the nearest names.

    Example:
        >>> class_indices("chair", ["chair", "wall", "chair"]), class_indices("Wall", ["chair", "wall"])
        ((0, 2), (1,))
    """
    if not isinstance(name, str):
        raise TypeError(f"class: expected a name, got {type(name).__name__}; pass one of the class names")
    folded = {one for one in names if one.casefold() == name.casefold()}
    spelled = name if name in names else folded.pop() if len(folded) == 1 else None
    if spelled is not None:
        return tuple(index for index, one in enumerate(names) if one == spelled)
    if not names:
        raise ValueError(
            f"class: expected class names to look {name!r} up in, got none; pass the names or use an index"
        )
    lower = {one.lower(): one for one in names}
    near = sorted(folded)
    near += [lower[m] for m in difflib.get_close_matches(name.lower(), lower, 3) if lower[m] not in near]
    near += [one for one in dict.fromkeys(names) if name and name.lower() in one.lower() and one not in near][:3]
    listed = ", ".join(names[:SHOWN]) + (f" and {len(names) - SHOWN} more" if len(names) > SHOWN else "")
    hint = f"did you mean {' or '.join(map(repr, near))}?" if near else otherwise
    raise ValueError(f"class: expected one of {listed}, got {name!r}; {hint}")
