"""What an uplift keeps so that more views can be added later: the sums over its views, and the corrections."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from .._card import short_repr
from .._rows import row_norms, unit_rows
from ..quant.linear import NOISE, LinearLatents, principal_directions


@dataclass(frozen=True, eq=False)
class UpliftSums:
    """The sums of `uplift_maps` over some views, for the Gaussians before they are merged.

    They take 16 d + 16 bytes for each of N Gaussians, and 4 for each number of the basis: about 240 bytes with 14 latents.
    """

    latents: LinearLatents
    """The directions that the sums are in."""
    sums: Tensor  # [2, N, d + 1]
    """Features and, in the last column, weights; of the even and of the odd views, not corrected."""
    corrections: Tensor  # [P, 2, N, d] float16
    """Of the pass before merging, and of the one after it: there the members of a merged Gaussian have the same one."""
    shown: Tensor  # [N]
    """Number of pixels that the Gaussian fills."""
    agreement: Tensor  # [N]
    """Of the Gaussian's pixels, as in `Uplifted`."""
    views: tuple[int, int]
    """Number of views, and how many of them were fused in one call, before others were added."""

    __repr__ = short_repr

    def lacking(self, index: int) -> Tensor | None:  # [2, N, d + 1]
        """The sums that a pass of corrections was computed from; None if there was no such pass."""
        if index >= len(self.corrections):
            return None
        weights = self.sums[..., -1:]
        return torch.cat([self.corrections[index].to(weights) * weights, weights], dim=-1)

    @property
    def outside(self) -> Tensor:  # [N]
        """Length of the sum of features in directions that the latents do not have; only the length is known."""
        whole = self.sums.sum(0)
        length = self.agreement * whole[:, -1]
        return (length.square() - row_norms(whole[:, :-1]).square()).clamp_min(0).sqrt()

    def to_tensors(self) -> dict[str, Tensor]:
        """The tensors that `from_tensors` reads."""
        names = ("sums", "corrections", "shown", "agreement")
        found = {name: getattr(self, name) for name in names}
        return {**found, "basis": self.latents.basis, "views": torch.tensor(self.views)}

    @staticmethod
    def from_tensors(tensors: Mapping[str, Tensor]) -> UpliftSums:
        """Sums from the tensors of `to_tensors`; other names are ignored."""
        names = ("sums", "corrections", "shown", "agreement")
        views, first = tensors["views"].tolist()
        return UpliftSums(
            LinearLatents(tensors["basis"]), **{name: tensors[name] for name in names}, views=(views, first)
        )


def add_sums(
    new: Tensor,  # [..., c + 1]
    old: Tensor | None,  # [..., k + 1], k <= c
) -> Tensor:  # [..., c + 1]
    """The sum of both. Old sums have fewer directions: the first ones."""
    if old is None:
        return new
    total, known = new.clone(), old.shape[-1] - 1
    total[..., :known] += old[..., :-1]
    total[..., -1] += old[..., -1]
    return total


def extend_directions(
    average: Tensor,  # [N, c] in working directions, of which the first are the old latents
    weights: Tensor,  # [N]
    known: int,
    keep: float,
    maximum: int,
) -> tuple[Tensor, float]:  # [c, d], the share
    """Add directions to the `known` first ones until they keep what `fit_linear_latents` with the same options would keep.

    Returns:
        The old directions and the new ones, orthonormal columns; the share of the variation about the main direction that
        the old ones alone do not keep. At most `maximum` columns, or the old ones if these are more.
    """
    if known == average.shape[1]:  # every channel is kept
        return torch.eye(known).to(average), 0.0
    rows = unit_rows(average).double()
    moment = rows.T @ (rows * weights.double()[:, None])
    largest = float(torch.linalg.eigvalsh(moment)[-1])
    beyond = float(moment.trace()) - largest
    values, vectors = principal_directions(moment[known:, known:])
    values = values * (values > NOISE * largest)
    outside = float(values.sum())
    after = outside - values.cumsum(0)
    allowed = (1 - keep) * beyond
    count = 0 if outside <= allowed else 1 + int((after > allowed).sum())
    count = max(0, min(count, maximum - known, len(values)))
    chosen = torch.zeros(len(moment), known + count).to(moment)
    chosen[:known, :known] = torch.eye(known).to(moment)
    chosen[known:, known:] = vectors[:, :count]
    return chosen.to(average), outside / beyond if beyond > 0 else 0.0
