"""Turn a query of a field (a class name, a label set or embeddings) into rows in the teacher's space."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor

from .._check import as_tensor, check_choice, check_shapes
from .._rows import unit_rows
from .label_set import LabelSet, teacher_mismatch

SAME = 1 - 1e-4  # cosine of one text embedded twice: half precision stays well above, other words below
AGAIN = "embed the words with the teacher whose features this field was fitted to"
Negatives = Literal["auto", "classes", "canonical", "none"]
Classes = LabelSet | Tensor  # classes with names, or embeddings [C, D] alone


def class_rows(classes: Classes, dim: int, info: dict[str, Any]) -> Tensor:  # [C, D]
    """The embeddings of a label set, or rows as they are, checked against a field's D and `info`.

    Warns if another teacher embedded them; raises a TypeError if it is neither, a ValueError for other channels.
    """
    if not isinstance(classes, LabelSet):
        try:
            rows = as_tensor("embeddings", classes, floating=True)
        except TypeError as error:
            got = f"{type(classes).__name__}; load_label_set reads one, make_label_set makes one"
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
    check_choice("negatives", negatives, ("auto", "classes", "canonical", "none"))
    against = nobody = row.new_zeros(0, dim)
    if negatives in ("auto", "classes") and rows is not None:
        against = rows[_unlike(rows, row)]
        if negatives == "auto" and not isinstance(target, str) and len(against) == len(rows):
            against = nobody  # the target is no class
    if negatives == "classes" and len(against) == 0:
        raise ValueError(f"negatives: expected other classes than {words!r}, got none; use 'canonical' or 'none'")
    if negatives in ("auto", "canonical") and len(against) == 0 and table is not None:
        against = _canonical(table, words, row)
    if negatives == "canonical" and len(against) == 0:
        raise ValueError(
            "negatives: expected canonical words in the table, got none; `kfgs features --words` makes some"
        )
    return torch.cat([row[None], against.to(row)])


def check_rows(name: str, rows: Tensor, axes: Sequence[str], dim: int) -> None:
    """Raise a ValueError unless rows have this shape. If only D differs, it asks whether the text is of another teacher."""
    if rows.ndim == len(axes) + 1 and rows.shape[-1] != dim:
        expected, got = ", ".join((*axes, str(dim))), tuple(rows.shape)
        raise ValueError(f"{name}: expected [{expected}], got {got}: text of another teacher? If so, {AGAIN}")
    check_shapes((name, rows, (*axes, dim)))


def _canonical(classes: LabelSet, words: str, row: Tensor) -> Tensor:  # [M, D]
    """The canonical negatives without the target, which is recognised by its words or its embedding."""
    if classes.negatives is None:
        return row.new_zeros(0, len(row))
    other_words = torch.tensor([word.casefold() != words.casefold() for word in classes.negative_names])
    kept = _unlike(classes.negatives, row) & other_words.to(classes.negatives.device)
    return classes.negatives[kept]


def _unlike(rows: Tensor, row: Tensor) -> Tensor:  # [M, D], [D] -> [M] bool
    """Which rows are embeddings of other words."""
    return unit_rows(rows) @ unit_rows(row[None]).to(rows)[0] <= SAME
