"""The evolving codebook of Sec. 3.3.1: it grows (Eq. 8), shrinks (Eq. 9), and its rows are optimised by Adam (Eq. 6)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from .._check import check_range, check_shapes
from .._rows import EPS, row_norms, unit_rows
from .codebook import Codebook
from .loss import class_balanced_loss

BETAS = (0.9, 0.999)  # Adam's usual decay rates; the paper names none


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


class EvolvingCodebook:
    """Codewords, their optimiser, and the gradients gathered since the last step, which grow and shrink together."""

    def __init__(
        self,
        codewords: Tensor,  # [K, D]
        *,
        learning_rate: float,
        eps: float,
        expand_below: float,
        prune_above: float,
        maximum: int,
        joins: int,
    ) -> None:
        self.alpha, self.beta, self.maximum, self.joins = expand_below, prune_above, maximum, joins
        self.adam = RowAdam(codewords, learning_rate=learning_rate, eps=eps)
        self.gradient, self.gathered = torch.zeros_like(codewords), 0

    @property
    def size(self) -> int:
        """Number of codewords, K."""
        return int(self.adam.rows.shape[0])

    @property
    def dim(self) -> int:
        """Channels of a codeword, D."""
        return int(self.adam.rows.shape[1])

    def learn_from(self, features: Tensor, tally: Tally) -> None:  # [n, D] of one image
        """Quantise, expand, and gather the gradient."""
        if features.shape[0] == 0:
            return
        index, similarity = Codebook(self.adam.rows).nearest(features)
        tally.see(similarity)
        room = min(self.joins, self.maximum - self.size)
        joining = features[admit(features, similarity, threshold=self.alpha, room=room)]
        if joining.shape[0] > 0:
            newest = Codebook(joining).nearest(features)
            index = torch.where(newest.similarity > similarity, newest.codeword + self.size, index)
            self.adam.append(joining)
            self.gradient = torch.cat([self.gradient, torch.zeros_like(joining)])
            tally.added += joining.shape[0]
        balanced = class_balanced_loss(features, self.adam.rows, index)
        self.gradient, self.gathered = self.gradient + balanced.gradient, self.gathered + 1
        tally.loss += float(balanced.loss)

    def step(self, tally: Tally) -> None:
        """Optimise with the mean of the gathered gradients, then prune."""
        if self.gathered == 0:  # every feature was zero
            return
        self.adam.step(self.gradient / self.gathered)
        self.gradient, self.gathered = torch.zeros_like(self.gradient), 0
        stays = prune(self.adam.rows, threshold=self.beta)
        if stays.numel() < self.size:
            tally.pruned += self.size - stays.numel()
            self.adam.keep(stays)
            self.gradient = self.gradient[stays]


class Tally:
    """Counts of one epoch."""

    def __init__(self, alpha: float) -> None:
        self.alpha = alpha
        self.added = self.pruned = self.features = self.covered = self.images = 0
        self.similarity = self.loss = 0.0

    def see(self, similarity: Tensor) -> None:  # [n] of one image
        """Count the features of one image."""
        self.features += similarity.numel()
        self.covered += int((similarity >= self.alpha).sum())
        self.similarity += float(similarity.sum(dtype=torch.float64))
        self.images += 1

    @property
    def coverage(self) -> float:
        """Share of the features that are at least alpha similar to their codeword."""
        return self.covered / max(self.features, 1)

    @property
    def mean_similarity(self) -> float:
        """Mean similarity of the features to their codewords."""
        return self.similarity / max(self.features, 1)

    def record(self) -> dict[str, Any]:
        """One row of the history."""
        return {
            "added": self.added,
            "pruned": self.pruned,
            "loss": self.loss / max(self.images, 1),
            "coverage": self.coverage,
            "mean_similarity": self.mean_similarity,
        }


class RowAdam:
    """Adam (Kingma & Ba 2015) that keeps a moment and a step count for each row.

    torch.optim.Adam counts steps for the whole matrix, so a row that joins late would start with wrongly corrected
    moments and a jump of about three learning rates; and a changed number of rows would lose all moments. For rows that
    are there from the start the two agree.
    """

    def __init__(self, rows: Tensor, *, learning_rate: float, eps: float) -> None:
        self.rows = rows.clone()  # [K, D]
        self.learning_rate, self.eps = learning_rate, eps
        self.first, self.second = torch.zeros_like(rows), torch.zeros_like(rows)  # moments of the gradient
        self.steps = _count(rows)  # [K, 1]

    def step(self, gradient: Tensor) -> None:  # [K, D]
        """Move every row against its gradient."""
        decay1, decay2 = BETAS
        self.steps = self.steps + 1
        self.first = self.first.lerp(gradient, 1 - decay1)
        self.second = decay2 * self.second + (1 - decay2) * gradient.square()
        bias1, bias2 = ((1 - decay**self.steps).to(gradient.dtype) for decay in BETAS)
        denominator = (self.second / bias2).sqrt() + self.eps
        self.rows = self.rows - self.learning_rate * (self.first / bias1) / denominator

    def append(self, rows: Tensor) -> None:  # [m, D]
        """Add rows with zero moments at step 0; the others keep theirs."""
        self.rows = torch.cat([self.rows, rows])
        self.first = torch.cat([self.first, torch.zeros_like(rows)])
        self.second = torch.cat([self.second, torch.zeros_like(rows)])
        self.steps = torch.cat([self.steps, _count(rows)])

    def keep(self, which: Tensor) -> None:  # [K'] int64
        """Keep some rows, with their moments, and drop the others."""
        self.rows, self.first, self.second = self.rows[which], self.first[which], self.second[which]
        self.steps = self.steps[which]


def _count(rows: Tensor) -> Tensor:
    """Zero steps for each row, in float64: 1 - 0.999 ** t cancels in float32."""
    return torch.zeros(rows.shape[0], 1, dtype=torch.float64, device=rows.device)
