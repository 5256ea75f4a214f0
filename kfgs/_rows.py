"""Rows of features: their lengths, their directions, and checks that read their values."""

from __future__ import annotations

import torch
from torch import Tensor

EPS = 1e-8  # the one epsilon of every cosine in kfgs: a row not longer than this counts as all-zero

REMOVE = "remove or repair such rows"
ENCODE = "encode that image again"


def unit_rows(x: Tensor, eps: float = EPS) -> Tensor:  # [..., D]
    """Divide each row by its length, or by `eps` where it is shorter, so that an all-zero row stays zero.

    In half precision, where `eps` would underflow, the smallest normal number of the type takes its place.
    """
    return x / row_norms(x)[..., None].clamp_min(max(eps, torch.finfo(x.dtype).tiny))


def row_norms(x: Tensor) -> Tensor:  # [..., D] -> [...]
    """Euclidean length of each row."""
    return torch.linalg.vector_norm(x, dim=-1)


def largest(rows: Tensor) -> tuple[Tensor, Tensor]:  # [N, K] -> [N], [N] int64
    """The largest number of each row, and the first place where it stands; without gradient."""
    if rows.device.type != "cpu" or rows.dtype not in (torch.float32, torch.float64):
        return torch.max(rows.detach(), dim=1)
    places = torch.from_numpy(rows.detach().numpy().argmax(axis=1))  # ten times as fast as torch's own search
    return rows.detach().gather(1, places[:, None])[:, 0], places


def unit_embeddings(embeddings: Tensor, name: str = "embeddings") -> Tensor:  # [C, D] -> [C, D]
    """Normalise class embeddings, refusing none at all, all-zero rows (they would beat every opposite) and NaN."""
    if len(embeddings) == 0:
        raise ValueError(f"{name}: expected at least one class, got {tuple(embeddings.shape)}; pass one row per class")
    lengths = row_norms(embeddings)
    check_directions(name, embeddings, lengths)
    if empty := (lengths <= EPS).nonzero()[:, 0].tolist():
        length = float(embeddings[empty[0]].double().norm())
        got = f"{f'a length of {length:.3g}' if length else 'all zeros'} in row {empty[0]}"
        raise ValueError(f"{name}: expected rows longer than {EPS:g}, got {got}; drop or replace it")
    return unit_rows(embeddings.detach())


def check_directions(name: str, rows: Tensor, lengths: Tensor | None = None, advice: str = REMOVE) -> None:
    """Raise a ValueError if the length of a row is not finite: for NaN, infinity, or numbers whose squares overflow.

    `lengths` are those of the rows [..., D], if they are known.
    """
    lengths = row_norms(rows) if lengths is None else lengths
    if bool(torch.isfinite(lengths).all()):
        return
    check_finite(name, rows, advice)
    largest = float(rows.abs().max())
    raise ValueError(
        f"{name}: expected numbers whose squares fit into {rows.dtype}, got {largest:.3g}; divide all of them by {largest:.0e}"
    )


def check_finite(name: str, values: Tensor, advice: str = REMOVE) -> None:
    """Raise a ValueError if a number is NaN or infinite."""
    finite = torch.isfinite(values)
    if not bool(finite.all()):
        row = int((~finite).nonzero()[0, 0])
        raise ValueError(f"{name}: expected finite numbers, got NaN or infinity in row {row}; {advice}")
