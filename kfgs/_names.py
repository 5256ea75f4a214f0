"""Look up the labels of a class name; the error for an unknown name offers similar names."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

SHOWN = 20  # names listed in a message


def class_indices(name: str, names: Sequence[str], otherwise: str = "take one of these classes") -> tuple[int, ...]:
    """The labels of a class, ascending. There are several if several classes have the same name.

    A name is looked up exactly, then without regard to case, if only one spelling fits.

    Raises:
        ValueError: if the name is unknown. The message offers similar names; if there are none, the advice is `otherwise`.

    Example:
        >>> class_indices("chair", ["chair", "wall", "chair"]), class_indices("Wall", ["chair", "wall"])
        ((0, 2), (1,))
    """
    if not isinstance(name, str):
        raise TypeError(f"class: expected a name, got {type(name).__name__}; an index needs no look-up")
    folded = {known for known in names if known.casefold() == name.casefold()}
    spelled = name if name in names else folded.pop() if len(folded) == 1 else None
    if spelled is not None:
        return tuple(index for index, known in enumerate(names) if known == spelled)
    if not names:
        raise ValueError(
            f"class: expected class names to look {name!r} up in, got none; pass the names or use an index"
        )
    lower = {known.lower(): known for known in names}
    alike = [lower[match] for match in difflib.get_close_matches(name.lower(), lower, 3)]
    alike += [known for known in dict.fromkeys(names) if name and name.lower() in known.lower()][:3]
    near = list(dict.fromkeys([*sorted(folded), *alike]))
    listed = ", ".join(names[:SHOWN]) + (f" and {len(names) - SHOWN} more" if len(names) > SHOWN else "")
    hint = f"did you mean {' or '.join(map(repr, near))}?" if near else otherwise
    raise ValueError(f"class: expected one of {listed}, got {name!r}; {hint}")
