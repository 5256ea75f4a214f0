"""Load a teacher by its name: one of the known kinds, or anything importable."""

from __future__ import annotations

import difflib
import importlib
import inspect
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .._card import error_line
from .._typed import typed
from .identity import code_identity, plain_options, weights_identity
from .protocol import Teacher, as_teacher
from .transformers_table import TRANSFORMERS


def _loader(name: str) -> Callable[..., Teacher]:
    """The function that makes the teacher of this name from weights and options."""
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


@typed
def load_teacher(name: str, weights: str | Path | None = None, **options: Any) -> Teacher:
    """Load a teacher.

    Args:
        name: one of `teacher_names()`, or your own `package.module:name`: a teacher, a function from [3, H, W] to
            [D, h, w], or a class, which is called with `weights` (if given) and the options. The current folder is
            searched for the module too. A teacher without `identity` gets one from source, code, weights and options, so
            that a cache notices changes (not all: see `identity.code_identity`).
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
    loader = _loader(name)
    _check_options(name, loader, options)
    return loader(weights, **options)


def check_teacher_name(name: str) -> None:
    """Raise a ValueError unless it is one of `teacher_names()`, or `package.module:name`, which is not imported here."""
    if not isinstance(name, str):
        raise TypeError(f"teacher: expected a name, got {type(name).__name__}; teacher_names() lists them")
    names = teacher_names()
    if ":" not in name and name not in names:
        near = difflib.get_close_matches(name.lower(), names, n=1)
        raise ValueError(
            f"teacher: expected one of {', '.join(names)}, or package.module:name of your own, got {name!r}"
            + (f"; did you mean {near[0]!r}?" if near else "; name one of them")
        )


def _check_options(name: str, loader: Callable[..., Teacher], options: dict[str, Any]) -> None:
    known = [option for option in inspect.signature(loader).parameters if option not in ("kind", "source", "weights")]
    for option in options:
        if option not in known:
            has = f"the options {', '.join(known)}" if known else "no options"
            raise ValueError(f"{option}: teacher {name!r} has {has}, but got {option}; leave it out")


def _imported(name: str, weights: str | Path | None, options: dict[str, Any]) -> Teacher:
    """The teacher `package.module:name`; the module may be in the folder where the command runs."""
    with _working_folder():
        found = _find(name)
        if inspect.isclass(found):
            given = [] if weights is None else [weights]
            _check_signature(name, found, given, options)
            found = found(*given, **options)
        elif weights is not None or options:
            raise ValueError(
                f"weights: expected none for {name!r}, which is made already, got {weights or ', '.join(options)}; name a "
                "class that takes them instead"
            )
    if not isinstance(found, Teacher) and not callable(found):
        raise ValueError(
            f"teacher: expected a teacher, a class of teachers or a function from [3, H, W] to [D, h, w], got "
            f"{type(found).__name__} behind {name!r}, which lacks name, encode_image or encode_text; see "
            "kfgs.teachers.Teacher"
        )
    if isinstance(getattr(found, "identity", None), dict):
        return as_teacher(found)
    return OwnTeacher(as_teacher(found), name, code_identity(found)["code"], weights, options)


def _find(name: str) -> Any:
    """Import the object `package.module:name`."""
    module_name, _, attribute = name.partition(":")
    try:
        importlib.invalidate_caches()
        return getattr(importlib.import_module(module_name), attribute)
    except (Exception, SystemExit) as error:  # a module may raise anything, or end like a script
        raise ValueError(
            f"teacher: expected package.module:name that can be imported, got {name!r} ({error_line(error)}); check both "
            "names, and that `import` of the module works"
        ) from error


def _check_signature(name: str, made: Callable[..., Any], given: list[Any], options: dict[str, Any]) -> None:
    """Raise a ValueError if a class does not take these weights and options."""
    try:
        signature = inspect.signature(made)
    except (TypeError, ValueError):  # a class of C has none
        return
    try:
        signature.bind(*given, **options)
    except TypeError as error:
        got = ", ".join([*(["weights"] if given else []), *options]) or "nothing"
        raise ValueError(
            f"weights, options: expected what {name!r} takes, {signature}, got {got} ({error}); pass just those"
        ) from error


@contextmanager
def _working_folder() -> Iterator[None]:
    """Inside the `with` block, modules are also searched for in the folder where the command runs."""
    if "" in sys.path:
        yield
        return
    sys.path.insert(0, "")
    try:
        yield
    finally:
        if "" in sys.path:  # entries that the module added stay
            sys.path.remove("")


class OwnTeacher:
    """Adds an `identity` to a user's teacher that has none; made by `load_teacher`.

    Args:
        teacher: the user's teacher; its other attributes are available here too.
        source: "package.module:name".
        code: digest of its code, from `code_identity`.
        weights: that it was made with; their digest is computed when `identity` is first read.
        options: that it was made with.
    """

    def __init__(
        self, teacher: Teacher, source: str, code: str, weights: str | Path | None, options: dict[str, Any]
    ) -> None:
        self._teacher, self._weights = teacher, weights
        self._known = {"source": source, "code": code, "options": plain_options(options)}
        self._digest: str | None = None

    def __repr__(self) -> str:
        return f"OwnTeacher({self._known['source']!r}, name={str(self.name)!r})"

    @property
    def name(self) -> str:
        """The teacher's name."""
        return self._teacher.name

    @property
    def identity(self) -> dict[str, Any]:
        """JSON: name, source, a digest of the code, options, and SHA-256 of the weights (None: no weights)."""
        if self._digest is None:
            self._digest = weights_identity(self._weights)
        return {"name": str(self.name), **self._known, "weights": self._digest}

    def to(self, device: torch.device | str) -> OwnTeacher:
        """Move the teacher to a device, if it can be moved."""
        move = getattr(self._teacher, "to", None)
        if move is not None:
            moved = move(device)
            self._teacher = moved if isinstance(moved, Teacher) else self._teacher
        return self

    def encode_image(self, image: Tensor) -> Tensor:  # [3, H, W] -> [D, h, w]
        """The result of the user's teacher."""
        return self._teacher.encode_image(image)

    def encode_text(self, prompts: Sequence[str]) -> Tensor:  # -> [n, D]
        """The result of the user's teacher."""
        return self._teacher.encode_text(prompts)

    def __getattr__(self, name: str) -> Any:  # called only for attributes not found here
        if name.startswith("_"):  # during copying or unpickling there is no teacher yet
            raise AttributeError(name)
        return getattr(self._teacher, name)
