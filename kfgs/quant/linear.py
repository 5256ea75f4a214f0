"""Latents that are linear in the feature: blends stay right, and a class is scored without a decoder."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .._card import short_repr
from .._check import check_shapes
from .._rows import unit_rows
from .store import Stored

NOISE = 1e-10  # of the first eigenvalue: rounding in float32 gives this much to directions that are not in the data


@dataclass(frozen=True, eq=False)
class LinearLatents(Stored):
    """Features f of D channels as d numbers z, with f = B z and orthonormal columns of B.

    Rendering blends latents, and B of a blend is the blend of the features. A cosine needs no feature either:
    f·t / |f| = z·(Bᵀ t) / |z|, d products whatever D is. There is no mean to add: B's first column is close to it.
    """

    basis: Tensor  # B [D, d]
    kind = "linear latents"

    def __post_init__(self) -> None:
        check_shapes(("basis", self.basis, "D d"))
        gram = self.basis.detach().T @ self.basis.detach()
        if not self.latent or not bool((gram - torch.eye(self.latent).to(gram)).abs().max() < 1e-3):
            raise ValueError("basis: expected orthonormal columns, got others; make one with fit_linear_latents")

    __repr__ = short_repr

    @property
    def dim(self) -> int:
        """Channels of a feature, D."""
        return int(self.basis.shape[0])

    @property
    def latent(self) -> int:
        """Channels of a latent, d."""
        return int(self.basis.shape[1])

    def encode(self, features: Tensor) -> Tensor:  # [..., D] -> [..., d]
        """The latents of features: Bᵀ f, the least-squares ones."""
        return features @ self.basis.to(features)

    def decode(self, latents: Tensor) -> Tensor:  # [..., d] -> [..., D]
        """The features of latents, B z, as long as the latents are."""
        return latents @ self.basis.T.to(latents)

    def cosines(self, latents: Tensor, rows: Tensor) -> Tensor:  # [..., d], [C, D] unit rows -> [..., C]
        """The cosine of each decoded feature with unit rows; 0 for an all-zero latent. No feature is made."""
        return unit_rows(latents) @ (rows.to(latents) @ self.basis.to(latents)).T


def principal_directions(moment: Tensor) -> tuple[Tensor, Tensor]:  # [D, D] sum of w f fᵀ -> [D], [D, D]
    """Eigenvalues of a second moment, the largest first, and their directions as columns.

    The sign of a column makes its entry of largest magnitude positive, so that the same data give the same latents.
    """
    values, vectors = torch.linalg.eigh(moment.double())
    values, vectors = values.flip(0).clamp_min(0), vectors.flip(1)
    largest = vectors.abs().argmax(dim=0)
    return values, vectors * torch.sign(vectors[largest, torch.arange(len(largest), device=largest.device)])


def fit_linear_latents(
    features: Tensor,  # [n, D]
    weights: Tensor | None = None,  # [n]
    *,
    keep: float = 0.99,
    maximum: int | None = None,
) -> LinearLatents:
    """The fewest latents that keep a stated share of the features' variation about their mean direction.

    Args:
        features: longer rows have more weight; normalise rows for equal weights. A ValueError if nothing is known of any.
        weights: of the rows; 1 if None.
        keep: share in (0, 1] of the energy beyond the first direction that the other latents must hold.
        maximum: the most latents; None: D.
    """
    rows = features.double()
    moment = rows.T @ (rows if weights is None else rows * weights.double()[:, None])
    if not bool(torch.isfinite(moment).all()) or not bool(moment.any()):
        raise ValueError("features: expected finite rows, not all of them zero, got others; check the teacher")
    values, vectors = principal_directions(moment)
    values = values * (values > NOISE * values[0])
    beyond = values[1:].cumsum(0)  # what the first 1, 2, ... further directions hold
    further = int((beyond < keep * beyond[-1]).sum()) + 1 if bool(beyond.any()) else 0  # the first that hold enough
    return LinearLatents(vectors[:, : min(maximum or len(vectors), 1 + further)].to(features))
