"""The classes of a scene and their text embeddings, in memory and as they lie beside its images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from dataclasses import field as default
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .._files import read_json
from .label_table import SUFFIX, LabelTable, read_label_table, write_label_table
from .names import class_index, class_indices


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
    """What a query is told from where no other classes are known: LERF's canonical words."""
    negative_names: tuple[str, ...] = ()
    info: dict[str, Any] = default(default_factory=dict)
    """Where the rows come from, as JSON: `teacher` (`teachers.identify`), `templates`, `synonyms`."""

    def __post_init__(self) -> None:
        if self.embeddings.ndim != 2 or len(self.names) != len(self.embeddings):
            raise ValueError(
                f"embeddings: expected [C, D] with C = {len(self.names)} (one row per name), "
                f"got {tuple(self.embeddings.shape)}; pass one row for each name"
            )
        if len(set(self.names)) != len(self.names):
            raise ValueError(f"names: expected different names, got {list(self.names)}; rename or leave out repeats")
        if any(not isinstance(name, str) or not name for name in (*self.names, *self.negative_names)):
            raise ValueError(f"names: expected words, got {list(self.names)!r:.200}; give each class a name")
        expected = (len(self.negative_names), self.dim)
        if (self.negatives is not None or self.negative_names) and _shape(self.negatives) != expected:
            raise ValueError(
                f"negatives: expected {expected} (from negative_names and embeddings), got {_shape(self.negatives)}; "
                "embed them with the same teacher, and name each"
            )

    def __len__(self) -> int:
        return len(self.names)

    def __repr__(self) -> str:
        shown = ", ".join(self.names[:5]) + (", ..." if len(self) > 5 else "")
        return f"LabelSet({len(self)} classes: {shown}; {self.dim} channels)"

    @property
    def dim(self) -> int:
        """D, the channels of the teacher's space."""
        return int(self.embeddings.shape[1])

    def index(self, name: str) -> int:
        """The label of a class; a ValueError offers names that are like an unknown one."""
        return class_index(name, self.names)

    def knows(self, name: str) -> bool:
        """Whether `index` finds a class of that name."""
        try:
            return bool(class_indices(name, self.names))
        except ValueError:
            return False

    def select(self, names: Sequence[str]) -> LabelSet:
        """The named classes alone, in the order given; labels count anew from 0.

        Raises:
            ValueError: if one is unknown (the message offers near ones), or named twice.
        """
        if isinstance(names, str):
            raise TypeError(f"names: expected a list of class names, got the text {names!r}; put it into a list")
        rows = [self.index(name) for name in names]
        return replace(self, names=tuple(self.names[row] for row in rows), embeddings=self.embeddings[rows])

    def with_class(self, name: str, embedding: Tensor) -> LabelSet:  # embedding: [D]
        """These classes and one more at the end, so that their labels stay.

        Raises:
            ValueError: if the name is taken, or the row has another number of channels.
        """
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
        table = LabelTable(self.names, self.embeddings, self.negatives, self.negative_names, self.info)
        write_label_table(path, table)


def load_label_set(classes: str | Path, embeddings: str | Path | None = None) -> LabelSet:
    """Read classes and their embeddings: from one table, or names and rows from two files.

    Args:
        classes: a table (.safetensors, as `LabelSet.save` writes), or class names (a JSON list of strings).
        embeddings: beside names: an .npy file [C, D] of floats, a row per name; or a table, of which those classes are
            taken in that order.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if a file is not what it should be, the counts differ, or embeddings are missing or one too many.
    """
    if Path(classes).suffix == SUFFIX:
        if embeddings is not None:
            raise ValueError(f"embeddings: expected none beside the table {classes}, got {embeddings}; leave it out")
        return LabelSet(*read_label_table(classes))
    names = read_json(classes)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names) or not names:
        raise ValueError(
            f'{classes}: expected a JSON list of class names like ["wall", "floor"], got {type(names).__name__}'
        )
    if embeddings is None:
        raise ValueError(
            f"embeddings: expected an .npy file of one row per name in {classes}, got none; pass it, or pass a table that "
            "`kfgs text` made in place of both"
        )
    if Path(embeddings).suffix == SUFFIX:
        return LabelSet(*read_label_table(embeddings)).select(names)
    return LabelSet(tuple(names), torch.from_numpy(_read_rows(Path(embeddings), len(names), classes)))


def teacher_mismatch(field: dict[str, Any], words: dict[str, Any]) -> str | None:
    """One line where a field was distilled from another teacher than the one that embedded the words; else None.

    Two encoders may well have the same number of channels and nothing else in common: of the 61 words that CLIP ViT-B/16
    (COCO-Stuff) and ViT-B/32 (LVIS) both embedded, none is the other's nearest. Only the name and the weights are
    compared, as other options (window, scales) do not concern text.

    Args:
        field: `info` of a SemanticField.
        words: `info` of a LabelSet.
    """
    found = teacher_difference(field, words)
    if found is None:
        return None
    key, ours, theirs = found
    return (
        f"classes: expected text of the field's teacher ({key} {ours!r:.40}), got text of another ({theirs!r:.40}); "
        "their spaces do not mix: embed the words with the field's teacher"
    )


def teacher_difference(one: dict[str, Any], other: dict[str, Any]) -> tuple[str, Any, Any] | None:
    """Whether two things come from different teachers: ("name" or "weights", the one's, the other's), or None.

    Args:
        one: `info` of a LabelSet or a SemanticField.
        other: of another; where either does not tell its teacher, nothing is known to differ.
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


def _read_rows(path: Path, count: int, classes: str | Path) -> Any:  # [C, D] float32
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected an .npy file with one embedding row per class")
    try:
        rows = np.load(path, allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise ValueError(f"{path}: expected an .npy file of numbers, but it cannot be read ({error})") from error
    if rows.ndim != 2 or rows.dtype.kind != "f" or len(rows) != count or not np.isfinite(rows).all():
        raise ValueError(
            f"{path}: expected finite floats [C, D] with C = {count} (from {classes}), got {rows.dtype} {rows.shape}"
        )
    return rows.astype(np.float32)
