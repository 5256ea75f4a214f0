"""Load a teacher by its name: one of the known kinds, or anything importable."""

from __future__ import annotations

import difflib
import importlib
import inspect
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from .._card import error_line
from .protocol import Teacher, as_teacher
from .transformers_table import TRANSFORMERS


def teacher_names() -> list[str]:
    """The teachers that `load_teacher` knows by name."""
    return ["lseg", *TRANSFORMERS, "sam"]


def load_teacher(name: str, weights: str | Path | None = None, **options: Any) -> Teacher:
    """Load a teacher.

    Args:
        name: one of `teacher_names()`, or your own `package.module:name`: a teacher, a function from [3, H, W] to
            [D, h, w], or a class, which is called with `weights` (if given) and the options. The current folder is
            searched for the module too.
        weights: a checkpoint file (lseg, sam), or a folder from `save_pretrained` or a hub id (all others).
        options: of the teacher: see `load_lseg`, `load_sam`, `load_transformers_teacher`.

    Raises:
        ValueError: if there is no such teacher or option, or the weights belong to another network; the message names it.
        FileNotFoundError: if the weights do not exist.
        ImportError: if a package is missing or broken.
    """
    check_teacher_name(name)
    if ":" in name:
        return _imported(name, weights, options)
    if weights is None:
        what = "a checkpoint file" if name in ("lseg", "sam") else "a folder of save_pretrained, or a hub id"
        raise ValueError(f"weights: expected {what} for teacher {name!r}, got none; kfgs downloads nothing by itself")
    loader: Callable[..., Teacher]
    if name == "lseg":
        from .lseg import load_lseg as loader
    elif name == "sam":
        from .sam import load_sam as loader
    else:
        from .transformers_teacher import load_transformers_teacher

        loader = partial(load_transformers_teacher, name)
    known = [option for option in inspect.signature(loader).parameters if option not in ("kind", "source", "weights")]
    for option in options:
        if option not in known:
            raise ValueError(f"{option}: teacher {name!r} has the options {', '.join(known) or 'none'}; leave it out")
    return loader(weights, **options)


def check_teacher_name(name: str | None, weights: object = None) -> None:
    """Raise a ValueError unless it is one of `teacher_names()`, or `package.module:name`, which is not imported here.

    A name of None is right without weights.
    """
    names = teacher_names()
    if name is None and weights is not None:
        raise ValueError(f"weights: expected --teacher with it, whose weights they are, got {weights} alone")
    if name is not None and ":" not in name and name not in names:
        near = difflib.get_close_matches(name.lower(), names, n=1)
        raise ValueError(
            f"teacher: expected one of {', '.join(names)}, or package.module:name of your own, got {name!r}"
            + (f"; did you mean {near[0]!r}?" if near else "; name one of them")
        )


def _imported(name: str, weights: str | Path | None, options: dict[str, Any]) -> Teacher:
    """The teacher `package.module:name`, with an `identity` of its name, version, weights and options if it has none."""
    value, given = _find(name), [] if weights is None else [weights]
    if inspect.isclass(value):
        try:
            value = value(*given, **options)
        except TypeError as error:
            got = ", ".join([*(["weights"] if given else []), *options]) or "nothing"
            raise ValueError(
                f"weights, options: expected what {name!r} takes, got {got} ({error}); pass just those"
            ) from error
    elif given or options:
        raise ValueError(
            f"weights: expected none for {name!r}, which is made already, got {weights or ', '.join(options)}; name a "
            "class that takes them instead"
        )
    try:
        teacher: Any = as_teacher(value)
    except TypeError as error:
        raise ValueError(f"{name}: {error}") from error
    if not isinstance(getattr(teacher, "identity", None), dict):
        plain = {
            key: part if isinstance(part, bool | int | float | str) else str(part) for key, part in options.items()
        }
        known = {"name": str(teacher.name), "version": str(getattr(teacher, "version", "")), "source": name}
        teacher.identity = {**known, "weights": None if weights is None else str(weights), "options": plain}
    return teacher  # type: ignore[no-any-return]


def _find(name: str) -> Any:
    """Import the object `package.module:name`; the folder where the command runs is searched too."""
    module_name, _, attribute = name.partition(":")
    added = "" not in sys.path
    sys.path[:0] = [""] if added else []
    try:
        importlib.invalidate_caches()
        return getattr(importlib.import_module(module_name), attribute)
    except (Exception, SystemExit) as error:  # a module may raise anything, or end like a script
        raise ValueError(
            f"teacher: expected package.module:name that can be imported, got {name!r} ({error_line(error)}); check both "
            "names, and that `import` of the module works"
        ) from error
    finally:
        if added and "" in sys.path:  # entries that the module added stay
            sys.path.remove("")
