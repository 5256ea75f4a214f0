"""Checks on rows of features and embeddings that several label modules share; these read values."""

from __future__ import annotations

import torch
from torch import Tensor

from ..quant.codebook import EPS, row_norms, unit_rows


def unit_embeddings(embeddings: Tensor, name: str = "embeddings") -> Tensor:  # [C, D] -> [C, D]
    """Normalise class embeddings, refusing none at all, all-zero rows (they would beat every opposite) and NaN."""
    if len(embeddings) == 0:
        raise ValueError(f"{name}: expected at least one class, got {tuple(embeddings.shape)}; pass one row per class")
    check_finite(name, embeddings)
    empty = row_norms(embeddings) <= EPS
    if bool(empty.any()):
        row = int(empty.nonzero()[0])
        raise ValueError(
            f"{name}: expected rows with a direction, got all zeros in row {row}; drop or replace that class"
        )
    return unit_rows(embeddings.detach())


def check_finite(name: str, values: Tensor) -> None:
    """Raise a ValueError if a number is NaN or infinite."""
    finite = torch.isfinite(values)
    if not bool(finite.all()):
        row = int((~finite).nonzero()[0, 0])
        raise ValueError(
            f"{name}: expected finite numbers, got NaN or infinity in row {row}; remove or repair such rows"
        )
