"""Adam on the rows of one matrix, where rows may come and go."""

from __future__ import annotations

import torch
from torch import Tensor

BETAS = (0.9, 0.999)  # Adam's usual decay rates; the paper names none


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
