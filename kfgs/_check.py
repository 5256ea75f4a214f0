"""Checks at the public edge: shapes bound by name across arguments, and messages with four parts.

A message says which argument, what was expected, what came, and what to do (STYLE 20). None of these checks reads
tensor values unless its name says so, so they cost no device synchronisation.
"""

from __future__ import annotations

import contextlib
import difflib
import math
import numbers
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

PARTS = ("embeddings", "codewords", "map", "means", "gaussians")  # where our objects keep what is mostly meant
SHOWN = 20  # class names listed in a message
ORIGIN = (0.0, 0.0, 0.0)  # of a scene whose coordinates are counted from the world's own zero
Progress = bool | Callable[[dict[str, Any]], None]
"""`progress` of every function that trains: True shows a bar, a function is called with each new row of the history."""


def as_origin(value: Any) -> tuple[float, float, float]:
    """Three finite numbers as Python floats (float64): a place in the world; a ValueError if they are not."""
    place = tuple(float(number) for number in value)
    if len(place) != 3 or not all(math.isfinite(number) for number in place):
        raise ValueError(f"origin: expected three finite numbers, got {place}; for instance (0, 0, 0)")
    return place


def check_shapes(*arguments: tuple[str, Any, str | tuple[str | int, ...]]) -> dict[str, int]:
    """Bind the axes of several tensors to one set of names and return their sizes.

    Args:
        arguments: triples `(name, tensor, spec)`; `spec` holds one word per axis, or is a tuple of words and numbers: a
            letter or word binds a size at its first appearance, a number must match exactly. A tensor that is None is
            skipped. A ValueError about an axis that disagrees names the argument that bound the size.

    Example:
        >>> import torch
        >>> check_shapes(("means", torch.zeros(5, 3), "N 3"), ("opacities", torch.zeros(5), "N"))
        {'N': 5}
    """
    sizes: dict[str, int] = {}
    bound_by: dict[str, str] = {}
    for name, value, spec in arguments:
        if value is None:
            continue
        words = spec.split() if isinstance(spec, str) else spec
        axes = [int(axis) if isinstance(axis, str) and axis.isdigit() else axis for axis in words]
        expected_shape = f"[{', '.join(map(str, axes))}]"
        if not hasattr(value, "shape"):
            got = f"{type(value).__name__}; {_instead(value)}"
            raise TypeError(f"{name}: expected a tensor of shape {expected_shape}, got {got}")
        shape = tuple(value.shape)  # no int(): a size may be a symbol while torch.compile or torch.export traces
        wrong = len(shape) != len(axes)
        own: dict[str, int] = {}  # an axis may also appear twice within one argument
        for axis, size in zip(axes, shape, strict=False):
            expected = sizes.get(axis, own.setdefault(axis, size)) if isinstance(axis, str) else axis
            wrong = wrong or size != expected
        if wrong:
            known = [f"{a} = {sizes[a]} (from {bound_by[a]})" for a in axes if isinstance(a, str) and a in sizes]
            where = f" with {', '.join(known)}" if known else ""
            raise ValueError(f"{name}: expected {expected_shape}{where}, got {shape}; pass a tensor of that shape")
        sizes, bound_by = own | sizes, dict.fromkeys(own, name) | bound_by
    return sizes


def as_tensor(name: str, value: Any, *, floating: bool = False) -> Tensor:
    """A tensor as it is; a NumPy array or a list of numbers as a tensor; a TypeError if it is something else.

    The tensor shares the memory of a NumPy array where torch can. The floats of a list get torch's default type, and so do
    its whole numbers if `floating` numbers are required (another TypeError). The messages say what to pass instead.
    """
    if not isinstance(value, Tensor):
        if isinstance(value, np.ma.MaskedArray):
            got = "a masked array; fill it with .filled(number)"
            raise TypeError(f"{name}: expected numbers without a mask, got {got}")
        is_list = isinstance(value, list | tuple | range | numbers.Real)
        array = np.empty(0, dtype=object)
        if is_list or hasattr(value, "__array__"):  # not our own sequences, which may read a file for each item
            with contextlib.suppress(ValueError, TypeError, RuntimeError):  # rows of different lengths, other objects
                array = np.asarray(value)
        if array.dtype.kind not in "fiub":
            advice = "pass numbers, in rows of equal length" if is_list else _instead(value)
            if isinstance(value, list | tuple) and any(isinstance(entry, str) for entry in value):
                advice = "pass numbers, not names; field.query(name) takes one name at a time"
            raise TypeError(f"{name}: expected a tensor, got {type(value).__name__}; {advice}")
        shared = array.flags.writeable and array.flags.aligned and array.dtype.isnative
        if not shared or any(stride < 0 for stride in array.strides):  # torch would refuse it, or warn
            array = np.array(array, dtype=array.dtype.newbyteorder("="))
        value = torch.from_numpy(array)
        if is_list and (value.is_floating_point() or (floating and value.dtype != torch.bool)):
            value = value.to(torch.get_default_dtype())
    if floating and not value.is_floating_point():
        raise TypeError(f"{name}: expected floating-point numbers, got {value.dtype}; convert them, as with .float()")
    return value


def as_array(values: Any, name: str = "values") -> np.ndarray[Any, Any]:
    """A tensor's values as a NumPy array, from any device and without its gradient; lists and arrays through NumPy.

    NumPy has no bfloat16: such values become float32. A TypeError for a text, or one of our objects that holds tensors.
    """
    if isinstance(values, Tensor):
        dense = values.detach().cpu()
        return (dense.float() if dense.dtype == torch.bfloat16 else dense).numpy()
    if isinstance(values, str) or any(hasattr(values, part) for part in PARTS):
        raise TypeError(f"{name}: expected numbers, got {type(values).__name__}; {_instead(values)}")
    return np.asarray(values)


def _instead(value: object) -> str:
    """What to pass in place of a value that is not a tensor."""
    if isinstance(value, str):
        lookups = "field.query(name) and OfClass(name).select(splats) look a class up"
        return f"pass the embedding, not the name {one_line(value)!r}; {lookups}"
    part = next((part for part in PARTS if hasattr(value, part)), None)
    return f"pass its .{part}" if part else "convert it with torch.as_tensor"


def check_choice(name: str, value: object, choices: Iterable[object]) -> None:
    """Raise a ValueError unless `value` is one of `choices`."""
    options = list(choices)
    if value not in options:
        near = difflib.get_close_matches(str(value).lower(), map(str, options), n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"{name}: expected one of {', '.join(map(repr, options))}, got {value!r}{hint}")


def check_range(
    name: str, value: Any, low: float, high: float = float("inf"), *, closed: tuple[bool, bool] = (True, True)
) -> None:
    """Raise a ValueError unless `value` is a finite number between `low` and `high` (`closed`: are the ends included)."""
    is_array = isinstance(value, Tensor | np.ndarray | np.generic)  # no getattr: it may be a symbol while torch traces
    if is_array:
        odd = math.prod(value.shape) != 1 or value.dtype in (torch.bool, np.bool_)
    else:
        odd = isinstance(value, bool) or not isinstance(value, int | float | numbers.Real)
    if odd:
        raise TypeError(f"{name}: expected a number, got {value!r:.80} ({type(value).__name__}); pass a float")
    over = value >= low if closed[0] else value > low
    under = value <= high if closed[1] else value < high
    if not (over and under and -math.inf < value < math.inf):  # NaN fails every comparison
        left = "[" if closed[0] and math.isfinite(low) else "("
        right = "]" if closed[1] and math.isfinite(high) else ")"
        raise ValueError(f"{name}: expected a number in {left}{low:g}, {high:g}{right}, got {value!r}")


def check_whole(name: str, value: float, low: float, high: float = float("inf")) -> None:
    """Raise a ValueError unless `value` is an integer (no float, no bool) from `low` to `high`, both included."""
    if not isinstance(value, numbers.Integral) or isinstance(value, bool):
        raise ValueError(f"{name}: expected a whole number, got {value!r}; pass an int")
    check_range(name, int(value), low, high)


def check_size(size: tuple[int, int], name: str = "size", low: int = 1) -> None:
    """Raise a ValueError unless `size` is (height, width) in whole pixels, each at least `low`."""
    if not isinstance(size, Sequence) or len(size) != 2:
        raise ValueError(f"{name}: expected (height, width), got {size!r}; pass two whole numbers of pixels")
    for axis, pixels in zip(("height", "width"), size, strict=True):
        check_whole(f"{name} ({axis})", pixels, low)


def as_progress(progress: Any) -> Progress:
    """A function as it is, a truth value as a bool."""
    return progress if callable(progress) else bool(progress)


def as_bar(progress: Any) -> bool:
    """`as_progress` where there is no history to call a function with (TypeError)."""
    if callable(progress):
        raise TypeError("progress: expected True or False, got a function; there are no rows to call it with")
    return bool(progress)


def one_line(text: object, length: int = 60) -> str:
    """Shorten a name from an untrusted file for a message: one line, no control characters."""
    shown = ascii(str(text))[1:-1]
    return shown if len(shown) <= length else shown[:length] + "..."


def class_indices(name: str, names: Sequence[str], otherwise: str = "take one of these classes") -> tuple[int, ...]:
    """The labels of a class, ascending. There are several if several classes have the same name.

    A name is looked up exactly, then without regard to case, if only one spelling fits. A ValueError if it is unknown; the
    message offers similar names, or if there are none the advice `otherwise`.

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
        raise ValueError(f"class: expected class names to look {name!r} up in, got none; pass names or use an index")
    lower = {known.lower(): known for known in names}
    alike = [lower[match] for match in difflib.get_close_matches(name.lower(), lower, 3)]
    alike += [known for known in dict.fromkeys(names) if name and name.lower() in known.lower()][:3]
    near = list(dict.fromkeys([*sorted(folded), *alike]))
    listed = ", ".join(names[:SHOWN]) + (f" and {len(names) - SHOWN} more" if len(names) > SHOWN else "")
    hint = f"did you mean {' or '.join(map(repr, near))}?" if near else otherwise
    raise ValueError(f"class: expected one of {listed}, got {name!r}; {hint}")
