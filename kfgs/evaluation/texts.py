"""Texts as protocols ask them: unit rows from a teacher's text encoder, or from a table of embeddings."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from .._rows import unit_embeddings
from ..labels import LabelSet
from ..scenes.files import some

Encode = Callable[[Sequence[str]], Tensor]
"""From texts to their embeddings [K, D] in the teacher's space; their length does not matter."""


def as_encoder(encode: Encode | LabelSet | None) -> Encode:
    """A text encoder as it is; a label set as an encoder of its classes and negatives. A ValueError if there is none."""
    if encode is None:
        raise ValueError("text: expected text embeddings, got none; pass a label set or a teacher's text encoder")
    if not isinstance(encode, LabelSet):
        return encode
    table = encode
    negatives = {} if table.negatives is None else dict(zip(table.negative_names, table.negatives, strict=True))

    def look_up(texts: Sequence[str]) -> Tensor:  # [K, D]
        missing = [text for text in texts if not table.knows(text) and text not in negatives]
        if missing:
            raise ValueError(
                f"text: expected embeddings of all {len(texts)} texts that the protocol asks, got none of "
                f"{some(missing, 3)} ({len(missing)} missing); pass a teacher with a text encoder, or a table with them"
            )
        rows = [table.embeddings[table.index(text)] if table.knows(text) else negatives[text] for text in texts]
        return torch.stack(rows).float()

    return look_up


def encode_unit(encode: Encode, texts: Sequence[str]) -> Tensor:  # [K, D]
    """Unit rows of some texts; a ValueError if `encode` gives another number of rows, zeros, or NaN."""
    if len(texts) == 0:
        raise ValueError("texts: expected at least one, got none; is the ground truth empty?")
    rows = encode(list(texts))
    if rows.ndim != 2 or len(rows) != len(texts):
        raise ValueError(
            f"encode: expected one row for each of {len(texts)} texts, got {tuple(rows.shape)}; return [K, D]"
        )
    return unit_embeddings(rows, "encode(texts)")
