"""The classes of a scene and their text embeddings, in memory and in files; and the rows that a query compares."""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from .._arrays import read_array, read_safetensors, reading, save_tensors
from .._card import cut
from .._check import as_tensor, check_choice, check_shapes, class_indices
from .._files import as_path, atomic_path, parse_json, read_json
from .._rows import unit_rows

KIND, VERSION = "label set", "1"  # of the metadata's "kfgs" and "version"
SUFFIX = ".safetensors"
SAME = 1 - 1e-4  # cosine of one text embedded twice: half precision stays well above, other words below
AGAIN = "embed the words with the teacher whose features this field was fitted to"
Negatives = Literal["auto", "classes", "canonical", "none"]


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


Classes = LabelSet | Tensor  # classes with names, or embeddings [C, D] alone


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
        raise ValueError(f"embeddings: expected an .npy file of one row per name in {classes}, got none; pass it too")
    if (path := as_path(embeddings)).suffix == SUFFIX:
        return _read_table(path).select(names)
    rows = read_array(path, "an .npy file of numbers, one embedding row per class")
    if rows.ndim != 2 or rows.dtype.kind != "f" or len(rows) != len(names) or not np.isfinite(rows).all():
        got = f"C = {len(names)} (from {classes}), got {rows.dtype} {rows.shape}"
        raise ValueError(f"{path}: expected finite floats [C, D] with {got}")
    with reading(classes, "a JSON list of different class names", "correct the list"):
        return LabelSet(tuple(names), torch.from_numpy(rows.astype(np.float32)))


def teacher_mismatch(info: dict[str, Any], other: dict[str, Any]) -> str | None:
    """How the teacher of another field's or label set's `info` differs, in words; None if no difference is known.

    Encoders have unrelated spaces: no word of 61 that CLIP ViT-B/16 and ViT-B/32 both embedded was nearest to itself.
    """
    ours, theirs = info.get("teacher"), other.get("teacher")
    if isinstance(ours, dict) and isinstance(theirs, dict):
        for key in ("name", "weights"):
            mine, its = ours.get(key), theirs.get(key)
            if mine is not None and its is not None and mine != its:
                return f"{key} {its!r:.40} instead of {mine!r:.40}"
    return None


def class_rows(classes: Classes, dim: int, info: dict[str, Any]) -> Tensor:  # [C, D]
    """The embeddings of a label set, or rows as they are, checked against a field's D and `info`.

    Warns if another teacher embedded them; raises a TypeError if it is neither, a ValueError for other channels.
    """
    if not isinstance(classes, LabelSet):
        try:
            rows = as_tensor("embeddings", classes, floating=True)
        except TypeError as error:
            got = f"{type(classes).__name__} {classes!r:.60}; query takes a name, load_label_set reads classes"
            raise TypeError(f"classes: expected a LabelSet or embeddings [C, {dim}], got {got}") from error
        check_rows("embeddings", rows, ("C",), dim)
        return rows
    difference, what, again = teacher_mismatch(info, classes.info), "text", AGAIN
    if "examples" in classes.info:
        what, again = "examples", "make them again: `kfgs features FIELD --examples FILE`"
    got = f"{what} of another teacher" + ("" if difference is None else f" ({difference})")
    if classes.embeddings.shape[1] != dim:
        got = f"{tuple(classes.embeddings.shape)}: {got}"
        raise ValueError(f"classes: expected embeddings [C, {dim}] (from the field), got {got}? If so, {again}")
    if difference is not None:
        warnings.warn(f"classes: expected those of the field's teacher, got {got}; {again}", stacklevel=4)
    return classes.embeddings


def make_question(
    target: str | Tensor,
    classes: Classes | None,
    negatives: Negatives | Tensor,
    dim: int,
    info: dict[str, Any],
) -> Tensor:  # [1 + M, D]
    """The rows of a target and of its negatives, the target first.

    With negatives "auto", a class (given by name or by its embedding) is compared with the other classes, or with the
    canonical words if it is the only class. Any other target is compared with the canonical words, or with nothing if there
    are none: not with the classes, because "chair" would exclude much of "office chair".
    """
    rows = None if classes is None else class_rows(classes, dim, info)
    table = classes if isinstance(classes, LabelSet) else None
    if isinstance(target, str):
        if table is None:
            got = f"{type(classes).__name__}; pass one, or an embedding"
            raise ValueError(f"classes: expected a LabelSet to look {target!r} up in, got {got}")
        index = table.index(target)
        row, words = table.embeddings[index], table.names[index]
    else:
        row, words = as_tensor("embedding", target, floating=True), "embedding"
        check_rows("embedding", row, (), dim)
        row = row if rows is None else row.to(rows)
    if not isinstance(negatives, str):
        against = as_tensor("negatives", negatives, floating=True)
        check_rows("negatives", against, ("M",), dim)
        return torch.cat([row[None], against.to(row)])
    rows = row.new_zeros(0, dim) if rows is None else rows
    against = rows[_unlike(rows, row)]
    of_class = isinstance(target, str) or len(against) < len(rows)
    if negatives == "canonical" or (negatives == "auto" and not (of_class and len(against))):
        against = rows[:0]
        if table is not None and table.negatives is not None:  # without the target, known by its words or its embedding
            other = torch.tensor([word.casefold() != words.casefold() for word in table.negative_names])
            against = table.negatives[_unlike(table.negatives, row) & other.to(table.negatives.device)]
    elif negatives not in ("auto", "classes"):
        check_choice("negatives", negatives, get_args(Negatives))
        against = rows[:0]
    if len(against) == 0 and negatives in ("classes", "canonical"):
        what = f"classes than {words!r}" if negatives == "classes" else "canonical words"
        what += " (`kfgs features --words` adds some)" * (negatives == "canonical")
        raise ValueError(f"negatives: expected other {what}, got none; use another, or 'none'")
    return torch.cat([row[None], against.to(row)])


def check_rows(name: str, rows: Tensor, axes: Sequence[str], dim: int) -> None:
    """Raise a ValueError unless rows have this shape. If only D differs, it asks whether the text is of another teacher."""
    if rows.ndim == len(axes) + 1 and rows.shape[-1] != dim:
        expected, got = ", ".join((*axes, str(dim))), tuple(rows.shape)
        raise ValueError(f"{name}: expected [{expected}], got {got}: text of another teacher? If so, {AGAIN}")
    check_shapes((name, rows, (*axes, dim)))


def _unlike(rows: Tensor, row: Tensor) -> Tensor:  # [M, D], [D] -> [M] bool
    """Which rows are embeddings of other words."""
    return unit_rows(rows) @ unit_rows(row[None]).to(rows)[0] <= SAME


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
