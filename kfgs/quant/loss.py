"""The class-balanced cosine loss of Eq. 6-7, with its gradient in closed form."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .._card import short_repr
from .._check import check_shapes
from .._rows import EPS, row_norms


class BalancedLoss(NamedTuple):
    """Value of Eq. 6, its gradient by the codewords, and N_tau."""

    loss: Tensor  # []
    gradient: Tensor  # [K, D], zero for a codeword without features
    counts: Tensor  # [K] int64, features of each codeword

    def __repr__(self) -> str:
        return short_repr(self)


def class_balanced_loss(
    features: Tensor,  # [n, D]
    codewords: Tensor,  # [K, D]
    index: Tensor,  # [n] int64
) -> BalancedLoss:
    """Mean over the classes present of the mean cosine distance within the class (Eq. 6-7).

    A class is a codeword that has features. With unit features u and the mean m of those of one class,
    mean(1 - cos(u, s)) = 1 - m . s/|s|, so one matrix product gives both the loss and its gradient

        dL/ds = -(m - (m . s/|s|) s/|s|) / (T |s|),

    without a loop over classes and without autograd (checked against autograd in the tests).

    Raises:
        ValueError: if shapes disagree.

    Note:
        No features: loss 0 and gradient 0. An all-zero feature counts as similarity 0; leave it out beforehand.
    """
    check_shapes(("features", features, "n D"), ("codewords", codewords, "K D"), ("index", index, "n"))
    n, K = features.shape[0], codewords.shape[0]
    counts = torch.bincount(index, minlength=K)
    T = (counts > 0).sum().clamp_min(1)
    # Row tau holds 1 / (N_tau |f_i|) where feature i is of class tau: a product, because index_add_ is not
    # repeatable on a GPU and not faster on a CPU.
    weights = features.new_zeros(K, n)
    inverse = 1.0 / (row_norms(features).clamp_min(EPS) * counts[index])
    weights[index, torch.arange(n, device=index.device)] = inverse.to(weights.dtype)
    means = weights @ features  # [K, D] mean of the unit features of each class
    norms = row_norms(codewords).clamp_min(EPS)[:, None]
    unit = codewords / norms
    similarity = (means * unit).sum(dim=1, keepdim=True)  # [K, 1]
    loss = ((1.0 - similarity[:, 0]) * (counts > 0)).sum() / T
    return BalancedLoss(loss, (similarity * unit - means) / (norms * T), counts)
