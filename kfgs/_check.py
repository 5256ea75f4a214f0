"""Checks at the public edge: shapes bound by name across arguments, and messages with four parts.

A message says which argument, what was expected, what came, and what to do (STYLE 20). None of these checks reads
tensor values unless its name says so, so they cost no device synchronisation.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Iterable, Sequence
from typing import Any


def check_shapes(*arguments: tuple[str, Any, str | tuple[str | int, ...]]) -> dict[str, int]:
    """Bind the axes of several tensors to one set of names and return their sizes.

    Args:
        arguments: triples `(name, tensor, spec)`; `spec` holds one word per axis, or is a tuple of words and numbers: a
            letter or word binds a size at its first appearance, a number must match exactly. A tensor that is None is
            skipped.

    Returns:
        The size of each named axis.

    Raises:
        TypeError: if an argument has no shape.
        ValueError: if an axis disagrees; the message names the argument that bound the size.

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
        if not hasattr(value, "shape"):
            raise TypeError(
                f"{name}: expected a tensor of shape [{', '.join(map(str, axes))}], got {type(value).__name__}; "
                "convert it with torch.as_tensor"
            )
        shape = tuple(value.shape)  # no int(): a size may be a symbol while torch.compile or torch.export traces
        wrong = len(shape) != len(axes)
        own: dict[str, int] = {}  # an axis may also appear twice within one argument
        for axis, size in zip(axes, shape, strict=False):
            expected = sizes.get(axis, own.setdefault(axis, size)) if isinstance(axis, str) else axis
            wrong = wrong or size != expected
        if wrong:
            known = [f"{a} = {sizes[a]} (from {bound_by[a]})" for a in axes if isinstance(a, str) and a in sizes]
            where = f" with {', '.join(known)}" if known else ""
            expected_shape = ", ".join(map(str, axes))
            raise ValueError(f"{name}: expected [{expected_shape}]{where}, got {shape}; pass a tensor of that shape")
        for axis, size in zip(axes, shape, strict=True):
            if isinstance(axis, str) and axis not in sizes:
                sizes[axis], bound_by[axis] = size, name
    return sizes


def check_choice(name: str, value: object, choices: Iterable[object]) -> None:
    """Raise a ValueError unless `value` is one of `choices`."""
    options = list(choices)
    if value not in options:
        raise ValueError(f"{name}: expected one of {', '.join(map(repr, options))}, got {value!r}")


def check_range(
    name: str, value: float, low: float, high: float = float("inf"), *, closed: tuple[bool, bool] = (True, True)
) -> None:
    """Raise a ValueError unless `value` is a finite number between `low` and `high` (`closed`: are the ends included)."""
    over = value >= low if closed[0] else value > low
    under = value <= high if closed[1] else value < high
    if not (over and under and -math.inf < value < math.inf):  # NaN fails every comparison
        left = "[" if closed[0] and math.isfinite(low) else "("
        right = "]" if closed[1] and math.isfinite(high) else ")"
        raise ValueError(f"{name}: expected a number in {left}{low:g}, {high:g}{right}, got {value!r}")


def check_whole(name: str, value: float, low: int, high: float = float("inf")) -> None:
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


def one_line(text: object, length: int = 60) -> str:
    """A name out of an untrusted file for a message: one line, no control characters, not long."""
    shown = ascii(str(text))[1:-1]
    return shown if len(shown) <= length else shown[:length] + "..."


def error_line(error: BaseException) -> str:
    """The first line of an error, with its type before it and at most 200 characters of its own."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0][:200] if lines else ''}".rstrip(": ")
