"""Text encoders for protocols: a table of embeddings, and one that notes what it was asked."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..labels import LabelSet
from ..scenes.files import some
from .relevancy import Encode


class TableEncoder:
    """Looks texts up in a label set: its classes, and its negatives.

    Args:
        table: names and embeddings.
    """

    def __init__(self, table: LabelSet) -> None:
        self.table = table

    def __call__(self, texts: Sequence[str]) -> Tensor:  # [K, D]
        """The rows of the texts.

        Raises:
            ValueError: if the table lacks one.
        """
        table = self.table
        negatives = {} if table.negatives is None else dict(zip(table.negative_names, table.negatives, strict=True))
        missing = [text for text in texts if not table.knows(text) and text not in negatives]
        if missing:
            raise ValueError(
                f"text: expected embeddings of all {len(texts)} texts that the protocol asks, got none of {some(missing, 3)} "
                f"({len(missing)} missing); pass a teacher with a text encoder, or a table that has them"
            )
        rows = [table.embeddings[table.index(text)] if table.knows(text) else negatives[text] for text in texts]
        return torch.stack(rows).float()


class NotedEncoder:
    """Passes texts on, and keeps them with their embeddings, so that a report can say which ones were used.

    Args:
        encode: from texts to embeddings.
    """

    def __init__(self, encode: Encode) -> None:
        self.encode, self.rows = encode, dict[str, Tensor]()

    def __call__(self, texts: Sequence[str]) -> Tensor:  # [K, D]
        """Embed the texts."""
        rows = self.encode(texts)
        if rows.ndim == 2 and len(rows) == len(texts):
            self.rows |= dict(zip(texts, rows, strict=True))
        return rows
