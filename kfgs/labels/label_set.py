"""The classes of a scene and their text embeddings, in memory and in a file."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from dataclasses import field as default
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .._arrays import read_array, read_safetensors, reading
from .._card import cut, html_card
from .._check import as_tensor
from .._files import as_path, atomic_path, parse_json, read_json
from .._names import class_index, class_indices
from .._tensors import save_tensors

KIND, VERSION = "label set", "1"  # of the metadata's "kfgs" and "version"
SUFFIX = ".safetensors"
SHOW_AGAIN = (
    "Make it again with this field: `kfgs text --examples FILE --field FIELD` (in Python: label_set_from_examples)"
)
"""The advice for classes by examples that do not fit a field."""


@dataclass(frozen=True, eq=False)
class LabelSet:
    """C class names with one embedding each, in the teacher's space; a label is an index into both.

    Example:
        >>> import torch
        >>> words = LabelSet(("wall", "chair"), torch.eye(2))
        >>> words.with_class("sofa", torch.tensor([0.6, 0.8])).select(["sofa", "wall"]).names
        ('sofa', 'wall')
    """

    names: tuple[str, ...]
    embeddings: Tensor  # [C, D], of any length
    negatives: Tensor | None = None  # [M, D]
    """LERF's canonical words: a query is compared with them if no other classes are known."""
    negative_names: tuple[str, ...] = ()
    info: dict[str, Any] = default(default_factory=dict)
    """The origin of the rows, as JSON: `teacher` (`teachers.identify`), `templates`, `synonyms`, `examples`."""

    def __post_init__(self) -> None:
        if isinstance(self.names, str):
            raise TypeError(
                f"names: expected a list of class names, got the text {self.names!r:.80}; put it into a list"
            )
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "embeddings", as_tensor("embeddings", self.embeddings, floating=True))
        if self.negatives is not None:
            object.__setattr__(self, "negatives", as_tensor("negatives", self.negatives, floating=True))
        if self.embeddings.ndim != 2 or len(self.names) != len(self.embeddings):
            raise ValueError(
                f"embeddings: expected [C, D] with C = {len(self.names)} (one row per name), "
                f"got {tuple(self.embeddings.shape)}; pass one row for each name"
            )
        if len(set(self.names)) != len(self.names):
            raise ValueError(f"names: expected different names, got {list(self.names)}; rename or leave out repeats")
        if any(not isinstance(name, str) or not name for name in (*self.names, *self.negative_names)):
            raise ValueError(f"names: expected words, got {list(self.names)!r:.200}; give each class a name")
        for name in (*self.names, *self.negative_names):
            if any("\ud800" <= character <= "\udfff" for character in name):
                raise ValueError(
                    f"names: expected text, got {name!a}, which has half of a pair of surrogates; write it again"
                )
        expected = (len(self.negative_names), self.dim)
        if (self.negatives is not None or self.negative_names) and _shape(self.negatives) != expected:
            raise ValueError(
                f"negatives: expected {expected} (from negative_names and embeddings), got {_shape(self.negatives)}; "
                "embed them with the same teacher, and name each"
            )

    def __len__(self) -> int:
        return len(self.names)

    def __repr__(self) -> str:
        return f"LabelSet({len(self)} classes: {cut(self._shown(5), 140)}; {self.dim} channels)"

    def _repr_html_(self) -> str:
        facts = {
            "classes": f"{len(self)}: {self._shown(12)}",
            "embeddings": self.embeddings,
            "negatives": self.negatives,
        }
        teacher = self.info.get("teacher")
        return html_card("LabelSet", facts | {"teacher": teacher.get("name") if isinstance(teacher, dict) else None})

    def _shown(self, count: int) -> str:
        return ", ".join(self.names[:count]) + (", ..." if len(self) > count else "")

    @property
    def dim(self) -> int:
        """D, the channels of the teacher's space."""
        return int(self.embeddings.shape[1])

    def index(self, name: str) -> int:
        """The label of a class; for an unknown name, a ValueError lists similar names."""
        return class_index(name, self.names, "add its embedding to the classes")

    def knows(self, name: str) -> bool:
        """Whether `index` finds a class of that name."""
        try:
            return bool(class_indices(name, self.names))
        except ValueError:
            return False

    def select(self, names: Sequence[str]) -> LabelSet:
        """Keep only the named classes; their order gives the new labels, from 0.

        Raises:
            ValueError: if one is unknown (the message offers near ones), or named twice.
        """
        if isinstance(names, str):
            raise TypeError(f"names: expected a list of class names, got the text {names!r}; put it into a list")
        rows = [self.index(name) for name in names]
        return replace(self, names=tuple(self.names[row] for row in rows), embeddings=self.embeddings[rows])

    def with_class(self, name: str, embedding: Tensor) -> LabelSet:  # embedding: [D]
        """Add a class at the end. The labels of the others stay.

        Raises:
            ValueError: if the name is taken, or the row has another number of channels.
        """
        embedding = as_tensor("embedding", embedding, floating=True)
        if _shape(embedding) != (self.dim,):
            raise ValueError(
                f"embedding: expected ({self.dim},) (from the {len(self)} classes), got {_shape(embedding)}; "
                "text of another teacher? embed the word with theirs"
            )
        row = embedding.detach().to(self.embeddings)[None]
        return replace(self, names=(*self.names, name), embeddings=torch.cat([self.embeddings, row]))

    def save(self, path: str | Path) -> None:
        """Write one .safetensors file with everything, names included; `load_label_set` reads it.

        Raises:
            ValueError: if the name does not end in .safetensors, or `info` is not JSON.
        """
        path = as_path(path)
        if path.suffix != SUFFIX:
            raise ValueError(f"path: expected a file name that ends in {SUFFIX}, got {path}; give another name")
        try:
            info = json.dumps(self.info, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"info: expected what JSON can hold, got {error}; use strings and finite numbers"
            ) from error
        parts = {"embeddings": self.embeddings} | ({} if self.negatives is None else {"negatives": self.negatives})
        names = {name: json.dumps(getattr(self, name)) for name in ("names", "negative_names")}
        with atomic_path(path) as temporary:
            tensors = {
                name: rows.detach().to("cpu", torch.float32).contiguous().clone() for name, rows in parts.items()
            }
            save_tensors(temporary, tensors, {"kfgs": KIND, "version": VERSION, "info": info} | names)


def load_label_set(classes: str | Path, embeddings: str | Path | None = None) -> LabelSet:
    """Read classes and their embeddings from one table, or from two files: names and rows.

    Args:
        classes: a table (.safetensors, from `LabelSet.save`), or class names (a JSON list of strings).
        embeddings: needed with class names: an .npy file [C, D] of floats with a row per name, or a table to take these
            classes from.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if a file has another content, the counts differ, or embeddings are missing or given twice.
    """
    if as_path(classes).suffix == SUFFIX:
        if embeddings is not None:
            raise ValueError(f"embeddings: expected none with the table {classes}, got {embeddings}; leave it out")
        return _read_table(as_path(classes))
    names = read_json(classes)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names) or not names:
        raise ValueError(
            f'{classes}: expected a JSON list of class names like ["wall", "floor"], got {type(names).__name__}'
        )
    if embeddings is None:
        raise ValueError(
            f"embeddings: expected an .npy file of one row per name in {classes}, got none; pass it, or pass a table that "
            "`kfgs text` made, instead of both"
        )
    if as_path(embeddings).suffix == SUFFIX:
        return _read_table(as_path(embeddings)).select(names)
    rows = torch.from_numpy(_read_rows(as_path(embeddings), len(names), classes))
    with reading(classes, "a JSON list of different class names", "correct the list"):
        return LabelSet(tuple(names), rows)


def teacher_mismatch(field: dict[str, Any], words: dict[str, Any]) -> str | None:
    """A message if the field's teacher and the teacher that embedded the words differ; else None.

    Two encoders can have the same number of channels and unrelated spaces: of the 61 words that CLIP ViT-B/16 (COCO-Stuff)
    and ViT-B/32 (LVIS) both embedded, no pair of embeddings of one word was nearest to each other. Only the name and the
    weights are compared; other options (window, scales) do not affect text.

    Args:
        field: `info` of a SemanticField.
        words: `info` of a LabelSet.
    """
    found = teacher_difference(field, words)
    if found is None:
        return None
    key, ours, theirs = found
    if "examples" in words:
        return (
            f"classes: expected examples in a field of this teacher ({key} {ours!r:.40}), got examples in a field of another "
            f"({theirs!r:.40}); their spaces do not mix. {SHOW_AGAIN}"
        )
    return (
        f"classes: expected text of the field's teacher ({key} {ours!r:.40}), got text of another ({theirs!r:.40}); "
        "their spaces do not mix: embed the words with the field's teacher"
    )


def teacher_difference(one: dict[str, Any], other: dict[str, Any]) -> tuple[str, Any, Any] | None:
    """The key in which two teachers differ, "name" or "weights", with both values; None if no difference is known.

    Args:
        one: `info` of a LabelSet or a SemanticField, which may not name its teacher.
        other: the same.
    """
    ours, theirs = one.get("teacher"), other.get("teacher")
    if not isinstance(ours, dict) or not isinstance(theirs, dict):
        return None
    for key in ("name", "weights"):
        mine, its = ours.get(key), theirs.get(key)
        if mine is not None and its is not None and mine != its:
            return key, mine, its
    return None


def _shape(rows: Tensor | None) -> tuple[int, ...] | None:
    return None if rows is None else tuple(rows.shape)


def _read_table(path: Path) -> LabelSet:
    """Read what `LabelSet.save` wrote."""
    expected, advice = f"a kfgs {KIND} (a table of words)", "make it again with `kfgs text`"
    parts, metadata = read_safetensors(path, expected, advice, kfgs=(KIND, VERSION))
    parts = {name: rows.float() for name, rows in parts.items()}
    for name, rows in parts.items():
        if rows.ndim != 2 or not torch.isfinite(rows).all():
            raise ValueError(f"{path}: expected finite rows of {name}, got others; {advice}")
    try:
        names, negative_names, info = (parse_json(metadata[key]) for key in ("names", "negative_names", "info"))
        return LabelSet(tuple(names), parts["embeddings"], parts.get("negatives"), tuple(negative_names), {**info})
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: expected {expected}, but it cannot be read ({error}); {advice}") from error


def _read_rows(path: Path, count: int, classes: str | Path) -> Any:  # [C, D] float32
    rows = read_array(path, "an .npy file of numbers, one embedding row per class")
    if rows.ndim != 2 or rows.dtype.kind != "f" or len(rows) != count or not np.isfinite(rows).all():
        raise ValueError(
            f"{path}: expected finite floats [C, D] with C = {count} (from {classes}), got {rows.dtype} {rows.shape}"
        )
    return rows.astype(np.float32)
