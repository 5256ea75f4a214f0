"""Rows of features: their lengths, their directions, and checks that read their values."""

from __future__ import annotations

import torch
from torch import Tensor

EPS = 1e-8  # the one epsilon of every cosine in kfgs: a row not longer than this counts as all-zero


def unit_rows(
    x: Tensor,  # [..., D]
    eps: float = EPS,
) -> Tensor:  # [..., D]
    """Divide each row by its length, or by `eps` where it is shorter: x / max(|x|, eps).

    An all-zero row stays zero, so its cosine with anything is 0 and never NaN. In half precision, where `eps` would
    underflow, the smallest normal number of the type takes its place.
    """
    return x / row_norms(x)[..., None].clamp_min(max(eps, torch.finfo(x.dtype).tiny))


def row_norms(x: Tensor) -> Tensor:  # [..., D] -> [...]
    """Euclidean length of each row."""
    return torch.linalg.vector_norm(x, dim=-1)


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
