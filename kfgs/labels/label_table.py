"""A table of words on disk: one .safetensors file with names, embeddings, negatives, and where they come from."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from .._files import atomic_path

KIND, VERSION = "label set", "1"  # of the metadata's "kfgs" and "version"
SUFFIX = ".safetensors"


class LabelTable(NamedTuple):
    """The parts of a label set, as they lie in its file."""

    names: tuple[str, ...]
    embeddings: Tensor  # [C, D] float32
    negatives: Tensor | None  # [M, D] float32
    negative_names: tuple[str, ...]
    info: dict[str, Any]


def write_label_table(path: str | Path, table: LabelTable) -> None:
    """Write a table, whole or not at all.

    Raises:
        ValueError: if the name does not end in .safetensors, or `info` is not JSON.
    """
    path = Path(path)
    if path.suffix != SUFFIX:
        raise ValueError(f"path: expected a file name that ends in {SUFFIX}, got {path}; give another name")
    try:
        info = json.dumps(table.info, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"info: expected what JSON can hold, got {error}; use strings and finite numbers") from error
    parts = {"embeddings": table.embeddings} | ({} if table.negatives is None else {"negatives": table.negatives})
    metadata = {
        "kfgs": KIND,
        "version": VERSION,
        "names": json.dumps(table.names),
        "negative_names": json.dumps(table.negative_names),
        "info": info,
    }
    with atomic_path(path) as temporary:
        tensors = {name: rows.detach().to("cpu", torch.float32).contiguous().clone() for name, rows in parts.items()}
        save_file(tensors, temporary, metadata=metadata)


def read_label_table(path: str | Path) -> LabelTable:
    """Read what `write_label_table` wrote.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is another file, damaged, or its numbers are not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected a table of words there, which `kfgs text` makes")
    try:
        with safe_open(path, framework="pt") as file:
            found = file.metadata() or {}
            if (found.get("kfgs"), found.get("version")) != (KIND, VERSION):
                raise ValueError(
                    f"{path}: expected a kfgs {KIND}, version {VERSION}, got {found.get('kfgs') or 'other tensors'} "
                    f"{found.get('version', '')}; make one with `kfgs text`"
                )
            parts = {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118 (no mapping)
        names, negative_names, info = (json.loads(found[key]) for key in ("names", "negative_names", "info"))
        table = LabelTable(tuple(names), parts["embeddings"], parts.get("negatives"), tuple(negative_names), {**info})
    except (SafetensorError, KeyError, TypeError, json.JSONDecodeError) as error:
        raise ValueError(
            f"{path}: expected a kfgs {KIND}, but it cannot be read ({error}); make it again with `kfgs text`"
        ) from error
    for name, rows in parts.items():
        if rows.ndim != 2 or not torch.isfinite(rows).all():
            raise ValueError(f"{path}: expected finite rows of {name}, got others; make it again with `kfgs text`")
    return table
