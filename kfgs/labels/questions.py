"""Turn a query of a field (a class name, a label set or embeddings) into rows in the teacher's space."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from .._card import short_repr
from .._check import as_tensor, check_choice, check_shapes
from .._rows import unit_rows
from .label_set import SHOW_AGAIN, LabelSet, teacher_difference, teacher_mismatch

SAME = 1 - 1e-4  # cosine of one text embedded twice: half precision stays well above, other words below
Negatives = Literal["auto", "classes", "canonical", "none"]
Classes = LabelSet | Tensor
"""Classes with names, or embeddings [C, D] alone."""


class Question(NamedTuple):
    """A target and its negatives, the rows it is compared with."""

    row: Tensor  # [D]
    negatives: Tensor | None  # [M, D]
    words: str

    def __repr__(self) -> str:
        return short_repr(self)

    @property
    def rows(self) -> Tensor:  # [1 + M, D]
        """The target, then its negatives."""
        return torch.cat([self.row[None], *([] if self.negatives is None else [self.negatives.to(self.row)])])


def class_rows(classes: Classes, dim: int, info: dict[str, Any]) -> Tensor:  # [C, D]
    """The embeddings of some classes, checked against a field's features. Warns if another teacher embedded them.

    Args:
        classes: a label set, or embeddings as a tensor, an array or a list of rows.
        dim: D of the field.
        info: of the field; it may name its teacher.

    Raises:
        TypeError: if it is neither.
        ValueError: if there is another number of channels.
    """
    if isinstance(classes, LabelSet):
        _check_words(classes, dim, info)
        return classes.embeddings
    try:
        rows = as_tensor("embeddings", classes, floating=True)
    except TypeError as error:
        raise TypeError(
            f"classes: expected a LabelSet or embeddings [C, {dim}], got {type(classes).__name__}; load_label_set reads one, "
            "make_label_set makes one"
        ) from error
    check_rows("embeddings", rows, ("C",), dim)
    return rows


def make_question(
    target: str | Tensor,
    classes: Classes | None,
    negatives: Negatives | Tensor,
    dim: int,
    info: dict[str, Any],
) -> Question:
    """The rows of a target and its negatives; see `SemanticField.query`.

    With negatives "auto", a class (given by name or by its embedding) is compared with the other classes, or with the
    canonical words if it is the only class. Any other target is compared with the canonical words, or with nothing if there
    are none: not with the classes, because "chair" would exclude much of "office chair".
    """
    if isinstance(negatives, str):
        check_choice("negatives", negatives, ("auto", "classes", "canonical", "none"))
    rows = None if classes is None else class_rows(classes, dim, info)
    named = isinstance(target, str)
    if isinstance(target, str):
        if not isinstance(classes, LabelSet):
            raise ValueError(
                f"classes: expected a LabelSet to look {target!r} up in, got {type(classes).__name__}; pass one, or an embedding"
            )
        index = classes.index(target)
        row, words = classes.embeddings[index], classes.names[index]
        others = classes.embeddings[_unlike(classes.embeddings, row)]
    else:
        check_rows("embedding", target, (), dim)
        target = as_tensor("embedding", target, floating=True)
        row, words = target if rows is None else target.to(rows), "embedding"
        others = row.new_zeros(0, dim) if rows is None else rows[_unlike(rows, row)]
    if not isinstance(negatives, str):
        negatives = as_tensor("negatives", negatives, floating=True)
        check_rows("negatives", negatives, ("M",), dim)
        return Question(row, negatives, words)
    table = classes if isinstance(classes, LabelSet) else None
    canonical = _canonical(table, words, row)
    if negatives == "auto":
        one_of_them = named or (rows is not None and len(others) < len(rows))  # by name, or by its own embedding
        either = (others, canonical) if one_of_them else (canonical,)
        return Question(row, next((some for some in either if some is not None and len(some)), None), words)
    if negatives == "classes" and len(others) == 0:
        raise ValueError(f"negatives: expected other classes than {words!r}, got none; use 'canonical' or 'none'")
    if negatives == "canonical" and canonical is None:
        raise ValueError(
            "negatives: expected canonical words in the classes' table, got none; make the table with `kfgs text`, or use "
            "'classes' or 'none'"
        )
    return Question(row, {"classes": others, "canonical": canonical, "none": None}[negatives], words)


def check_rows(name: str, rows: Tensor | None, axes: Sequence[str], dim: int) -> None:
    """Raise a ValueError unless rows have this shape. If only D differs, it asks whether the text is of another teacher."""
    shape = tuple(getattr(rows, "shape", ()))
    if len(shape) == len(axes) + 1 and shape[-1] != dim:
        expected = ", ".join((*axes, str(dim)))
        raise ValueError(
            f"{name}: expected [{expected}], got {shape}: text of another teacher? Embed the words with the teacher "
            "whose features this field was fitted to"
        )
    check_shapes((name, rows, (*axes, dim)))


def _canonical(classes: LabelSet | None, words: str, row: Tensor) -> Tensor | None:  # [M, D]
    """The canonical negatives without the target, which is recognised by its words or its embedding."""
    if classes is None or classes.negatives is None:
        return None
    other_words = torch.tensor([word.casefold() != words.casefold() for word in classes.negative_names])
    kept = _unlike(classes.negatives, row) & other_words.to(classes.negatives.device)
    return classes.negatives[kept] if bool(kept.any()) else None


def _unlike(rows: Tensor, row: Tensor) -> Tensor:  # [M, D], [D] -> [M] bool
    """Which rows are embeddings of other words."""
    return unit_rows(rows) @ unit_rows(row[None]).to(rows)[0] <= SAME


def _check_words(classes: LabelSet, dim: int, info: dict[str, Any]) -> None:
    if classes.dim != dim:
        wanted = f"classes: expected embeddings [C, {dim}] (from the field), got {tuple(classes.embeddings.shape)}"
        if "examples" in classes.info:
            raise ValueError(f"{wanted}: the examples of this table belong to another field. {SHOW_AGAIN}")
        words = teacher_difference(info, classes.info)
        difference = "" if words is None else f" ({words[0]} {words[2]!r:.40} instead of {words[1]!r:.40})"
        raise ValueError(
            f"{wanted}: text of another teacher?{difference} Embed the words with the teacher whose features this field was "
            "fitted to"
        )
    mismatch = teacher_mismatch(info, classes.info)
    if mismatch is not None:
        warnings.warn(mismatch, stacklevel=4)
