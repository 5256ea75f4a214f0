"""The classes of a scene and their text embeddings, in memory and in a file."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .._arrays import read_array, read_safetensors, reading, save_tensors
from .._card import cut
from .._check import as_tensor, check_shapes, class_indices
from .._files import as_path, atomic_path, parse_json, read_json

KIND, VERSION = "label set", "1"  # of the metadata's "kfgs" and "version"
SUFFIX = ".safetensors"


@dataclass(frozen=True, eq=False)
class LabelSet:
    """C class names with one embedding each, in the teacher's space; a label is an index into both.

    Example:
        >>> LabelSet(("wall", "chair", "sofa"), torch.eye(3)).select(["sofa", "wall"]).names
        ('sofa', 'wall')
    """

    names: tuple[str, ...]
    embeddings: Tensor  # [C, D], of any length
    negatives: Tensor | None = None  # [M, D]
    """LERF's canonical words: a query is compared with them if no other classes are known."""
    negative_names: tuple[str, ...] = ()
    info: dict[str, Any] = field(default_factory=dict)
    """The origin of the rows, as JSON: `teacher` (`teachers.identify`), `templates`, `synonyms`, `examples`."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", _as_list(self.names))
        words = (*self.names, *self.negative_names)
        if any(not isinstance(name, str) or not name or not name.isprintable() for name in words):
            raise ValueError(f"names: expected words, got {list(words)!r:.200}; give each class a name")
        if len(set(self.names)) != len(self.names):
            raise ValueError(f"names: expected different names, got {list(self.names)}; rename or leave out repeats")
        object.__setattr__(self, "embeddings", as_tensor("embeddings", self.embeddings, floating=True))
        check_shapes(("embeddings", self.embeddings, (len(self.names), "D")))
        if self.negatives is not None or self.negative_names:
            object.__setattr__(self, "negatives", as_tensor("negatives", self.negatives, floating=True))
            check_shapes(("negatives", self.negatives, (len(self.negative_names), self.dim)))

    def __len__(self) -> int:
        return len(self.names)

    def __repr__(self) -> str:
        return f"LabelSet({len(self)} classes: {cut(', '.join(self.names[:12]), 140)}; {self.dim} channels)"

    @property
    def dim(self) -> int:
        """D, the channels of the teacher's space."""
        return int(self.embeddings.shape[1])

    def index(self, name: str) -> int:
        """The label of a class; for an unknown name, a ValueError lists similar names."""
        if name in self.names:
            return self.names.index(name)
        return class_indices(name, self.names, "add its embedding to the classes")[0]

    def knows(self, name: str) -> bool:
        """Whether `index` finds a class of that name."""
        return name.casefold() in map(str.casefold, self.names)

    def select(self, names: Sequence[str]) -> LabelSet:
        """Keep only the named classes; their order gives the new labels, from 0. A ValueError for an unknown name."""
        rows = [self.index(name) for name in _as_list(names)]
        return replace(self, names=tuple(self.names[row] for row in rows), embeddings=self.embeddings[rows])

    def save(self, path: str | Path) -> None:
        """Write one .safetensors file with everything, names included; `load_label_set` reads it.

        A ValueError if the name does not end in .safetensors, or `info` is not JSON.
        """
        path = as_path(path)
        if path.suffix != SUFFIX:
            raise ValueError(f"path: expected a name that ends in {SUFFIX}, got {path.name!r}; rename it")
        texts = {"kfgs": KIND, "version": VERSION}
        try:
            for name in ("names", "negative_names", "info"):
                texts[name] = json.dumps(getattr(self, name), allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ValueError(f"info: expected what JSON can hold, got {error}; use texts and numbers") from error
        parts = {"embeddings": self.embeddings} | ({} if self.negatives is None else {"negatives": self.negatives})
        tensors = {name: rows.detach().to("cpu", torch.float32).contiguous().clone() for name, rows in parts.items()}
        with atomic_path(path) as temporary:
            save_tensors(temporary, tensors, texts)


def load_label_set(classes: str | Path, embeddings: str | Path | None = None) -> LabelSet:
    """Read classes and their embeddings from one table, or from two files: names and rows.

    `classes` is a table (.safetensors, from `LabelSet.save`), or class names (a JSON list of strings). With class names,
    `embeddings` is an .npy file [C, D] of floats with a row per name, or a table to take the classes from. A ValueError names
    the file that has another content.
    """
    if as_path(classes).suffix == SUFFIX:
        if embeddings is not None:
            raise ValueError(f"embeddings: expected none with the table {classes}, got {embeddings}; leave it out")
        return _read_table(as_path(classes))
    names = read_json(classes)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names) or not names:
        raise ValueError(f'{classes}: expected a list of class names, ["wall", "floor"], got {type(names).__name__}')
    if embeddings is None:
        raise ValueError(
            f"embeddings: expected an .npy file of one row per name in {classes}, got none; pass it as well"
        )
    if (path := as_path(embeddings)).suffix == SUFFIX:
        return _read_table(path).select(names)
    rows = read_array(path, "an .npy file of numbers, one embedding row per class")
    if rows.ndim != 2 or rows.dtype.kind != "f" or len(rows) != len(names) or not np.isfinite(rows).all():
        raise ValueError(
            f"{path}: expected finite floats [C, D] with C = {len(names)} (from {classes}), got {rows.dtype} {rows.shape}"
        )
    with reading(classes, "a JSON list of different class names", "correct the list"):
        return LabelSet(tuple(names), torch.from_numpy(rows.astype(np.float32)))


def teacher_mismatch(one: dict[str, Any], other: dict[str, Any]) -> str | None:
    """How the teacher of another field's or label set's `info` differs, in words; None if no difference is known.

    Encoders have unrelated spaces: no word of 61 that CLIP ViT-B/16 and ViT-B/32 both embedded was nearest to itself.
    """
    ours, theirs = one.get("teacher"), other.get("teacher")
    if isinstance(ours, dict) and isinstance(theirs, dict):
        for key in ("name", "weights"):
            mine, its = ours.get(key), theirs.get(key)
            if mine is not None and its is not None and mine != its:
                return f"{key} {its!r:.40} instead of {mine!r:.40}"
    return None


def _as_list(names: Sequence[str]) -> tuple[str, ...]:
    if isinstance(names, str):
        raise TypeError(f"names: expected a list of class names, got the text {names!r:.80}; put it into a list")
    return tuple(names)


def _read_table(path: Path) -> LabelSet:
    """Read what `LabelSet.save` wrote."""
    expected, advice = f"a kfgs {KIND} (a table of words)", "make it again with `kfgs features --words`"
    parts, metadata = read_safetensors(path, expected, advice, kfgs=(KIND, VERSION))
    with reading(path, expected, advice):
        for name, rows in parts.items():
            if rows.ndim != 2 or not torch.isfinite(rows).all():
                raise ValueError(f"it has other {name} than finite rows")
        tables = {name: rows.float() for name, rows in parts.items()}
        names, negative_names, info = (parse_json(metadata[key]) for key in ("names", "negative_names", "info"))
        return LabelSet(tuple(names), tables["embeddings"], tables.get("negatives"), tuple(negative_names), {**info})
