"""A teacher by its name: one row of a table per kind, and anything importable beside them."""

from __future__ import annotations

import difflib
import importlib
import inspect
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from .protocol import Teacher, as_teacher
from .transformers_table import TRANSFORMERS


def _loader(name: str) -> Callable[..., Teacher]:
    """What makes the teacher of a name from weights and options."""
    if name == "lseg":
        from .lseg import load_lseg

        return load_lseg
    if name == "sam":
        from .sam import load_sam

        return load_sam
    from .transformers_teacher import load_transformers_teacher

    return partial(load_transformers_teacher, name)


def teacher_names() -> list[str]:
    """The teachers that `load_teacher` knows by name."""
    return ["lseg", *TRANSFORMERS, "sam"]


def load_teacher(name: str, weights: str | Path | None = None, **options: Any) -> Teacher:
    """Load a teacher.

    Args:
        name: one of `teacher_names()`, or `package.module:name` of your own: a teacher, a function from [3, H, W] to
            [D, h, w], or a class, which is called with `weights` (if given) and the options.
        weights: a checkpoint file (lseg, sam), or a folder as `save_pretrained` writes it or a hub id (all others).
        options: of the kind: see `load_lseg`, `load_sam`, `load_transformers_teacher`.

    Raises:
        ValueError: if there is no such teacher or option, or the weights are another's; the message says whose.
        FileNotFoundError: if the weights are not there.
        ImportError: if a package is missing.
    """
    if ":" in name:
        return _imported(name, weights, options)
    names = teacher_names()
    if name not in names:
        near = difflib.get_close_matches(name.lower(), names, n=1)
        raise ValueError(
            f"teacher: expected one of {', '.join(names)}, or package.module:name of your own, got {name!r}"
            + (f"; did you mean {near[0]!r}?" if near else "; name one of them")
        )
    if weights is None:
        what = "a checkpoint file" if name in ("lseg", "sam") else "a folder of save_pretrained, or a hub id"
        raise ValueError(f"weights: expected {what} for teacher {name!r}, got none; kfgs downloads nothing by itself")
    loader = _loader(name)
    _check_options(name, loader, options)
    return loader(weights, **options)


def _check_options(name: str, loader: Callable[..., Teacher], options: dict[str, Any]) -> None:
    known = [option for option in inspect.signature(loader).parameters if option not in ("kind", "source", "weights")]
    for option in options:
        if option not in known:
            words = f"one of {', '.join(known)}" if known else "none"
            raise ValueError(f"{option}: expected {words} as option of teacher {name!r}, got {option}; leave it out")


def _imported(name: str, weights: str | Path | None, options: dict[str, Any]) -> Teacher:
    """The teacher that `package.module:name` stands for; the folder in which the command runs counts."""
    module_name, _, attribute = name.partition(":")
    if "" not in sys.path:
        sys.path.insert(0, "")
    try:
        found = getattr(importlib.import_module(module_name), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(
            f"teacher: expected package.module:name that can be imported, got {name!r} ({error}); check both names"
        ) from error
    if inspect.isclass(found):
        made: Any = found(*([] if weights is None else [weights]), **options)
        return as_teacher(made)
    if weights is not None or options:
        raise ValueError(
            f"weights: expected none for {name!r}, which is made already, got {weights or ', '.join(options)}; name a class "
            "that takes them instead"
        )
    return as_teacher(found)
