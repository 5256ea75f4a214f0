"""How the codebook grows (Eq. 8) and shrinks (Eq. 9), as pure functions that say which rows come and go."""

from __future__ import annotations

import torch
from torch import Tensor

from .._check import check_range, check_shapes
from .._rows import EPS, row_norms, unit_rows


def expand(
    codewords: Tensor,  # [K, D]
    features: Tensor,  # [n, D]
    *,
    threshold: float = 0.9,
    maximum: int = 100,
) -> Tensor:  # [m] int64
    """Choose the features that join the codebook because no codeword is similar enough to them (Eq. 8).

    The least similar feature joins first; similarities are then updated, and so on until every feature is at least
    `threshold` similar to a codeword or the codebook holds `maximum`: farthest-point sampling that goes on from the
    codebook. So each feature is below the threshold at the moment it joins, and near-duplicates never fill the book.

    Args:
        codewords: the codebook so far.
        features: features of one image; all-zero rows never join.
        threshold: the paper's alpha.
        maximum: the paper's K_max.

    Returns:
        Rows of `features` in the order of joining, perhaps none.

    Raises:
        ValueError: if shapes disagree, or the threshold is not a cosine.

    Note:
        The paper admits in batches every feature below alpha; its released script takes the least similar ones without
        updating similarities, and may exceed K_max by one. Ties go to the lowest row.
    """
    check_shapes(("codewords", codewords, "K D"), ("features", features, "n D"))
    check_range("threshold", threshold, -1, 1)
    unit = unit_rows(features)
    best = (unit @ unit_rows(codewords).T).amax(dim=1)
    return admit(features, best, threshold=threshold, room=maximum - codewords.shape[0])


def admit(
    features: Tensor,  # [n, D]
    similarity: Tensor,  # [n]
    *,
    threshold: float,
    room: int,
) -> Tensor:  # [m] int64
    """`expand`, for a caller who already knows each feature's similarity to its codeword and how many may join."""
    rows = (similarity < threshold).nonzero()[:, 0][: None if room > 0 else 0]
    rows = rows[row_norms(features[rows]) > EPS]
    unit, best = unit_rows(features[rows]), similarity[rows].clone()
    chosen: list[int] = []
    while len(chosen) < room and best.numel() > 0:
        least = int(best.argmin())
        if not float(best[least]) < threshold:
            break
        chosen.append(least)
        best = torch.maximum(best, unit @ unit[least])
        best[least] = torch.inf  # present now, whatever rounding makes of its cosine with itself
    return rows[torch.tensor(chosen, dtype=torch.int64, device=rows.device)]


def prune(
    codewords: Tensor,  # [K, D]
    *,
    threshold: float = 0.99,
) -> Tensor:  # [K'] int64
    """Choose the codewords that stay when the later of any two that are too similar is dropped (Eq. 9).

    Codewords are visited in order, and one is dropped if its cosine with an earlier one *that stays* exceeds
    `threshold` (the paper's beta). So each dropped codeword has a stand-in, and pruning twice changes nothing.

    Returns:
        Rows that stay, ascending; never empty for K > 0.

    Raises:
        ValueError: if `codewords` is not [K, D], or the threshold is not a cosine.

    Note:
        The paper drops f_g of a pair e < g, the released script f_e.
    """
    check_shapes(("codewords", codewords, "K D"))
    check_range("threshold", threshold, -1, 1)
    unit = unit_rows(codewords)
    close = (unit @ unit.T > threshold).triu(diagonal=1).cpu()  # K is small
    stays = torch.ones(codewords.shape[0], dtype=torch.bool)
    for e in close.any(dim=1).nonzero()[:, 0].tolist():
        if stays[e]:
            stays &= ~close[e]
    return stays.nonzero()[:, 0].to(codewords.device)
