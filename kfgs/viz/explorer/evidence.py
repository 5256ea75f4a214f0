"""What the views say about each Gaussian, gathered in one pass, so that every later question is a small matrix product."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from ...cameras import Camera
from ...labels import label_codewords, nearest_codeword
from ...labels._rows import unit_embeddings
from ...labels.vote import MIN_SHARE
from ...quant.codebook import unit_rows
from ...splat import accumulate_pixels, bin_tiles, project

if TYPE_CHECKING:
    from ...fields import SemanticField
    from ...gaussians import Gaussians

CHUNK = 8192  # pixels quantised at once, as in SemanticField
SIGNAL = 1 << 26  # numbers: a signal [H, W, channels] of at most 268 MB at a time
TIES = 1e-6  # of a share: votes are added up in another order than `vote_labels` adds them


class Evidence(NamedTuple):
    """Which codewords the pixels of some views show where each Gaussian is seen."""

    sums: Tensor  # [N, K] rendering weight w = T alpha of each Gaussian on pixels of each codeword
    weights: Tensor  # [N] w on all pixels
    codewords: Tensor  # [K, D]

    def averages(
        self,
        rows: Tensor,  # [M, D]
    ) -> Tensor:  # [N, M]
        """The mean cosine of each Gaussian's pixels with some rows, as `average_views` finds it; 0 where it is not seen."""
        cosines = unit_rows(self.codewords) @ unit_embeddings(rows, "embedding, negatives").to(self.codewords).T
        return self.sums @ cosines.to(self.sums) / self._some(self.weights)[:, None]

    def vote(
        self,
        embeddings: Tensor,  # [C, D]
    ) -> tuple[Tensor, Tensor]:  # labels [N] int64, shares [N]
        """The class that most of each Gaussian's pixels have, and its share, as `vote_labels` finds them."""
        table = label_codewords(self.codewords, embeddings).labels
        votes = torch.zeros(len(self.sums), len(embeddings)).to(self.sums)
        votes.index_add_(1, table[table >= 0].to(votes.device), self.sums[:, table >= 0])
        cast = votes.sum(dim=1)
        best, labels = votes.max(dim=1)
        shares = best / self._some(cast)
        return torch.where((cast > 0) & (shares >= MIN_SHARE - TIES), labels, -1), shares

    @staticmethod
    def _some(weights: Tensor) -> Tensor:
        return weights.clamp_min(torch.finfo(weights.dtype).tiny)


def gather_evidence(field: SemanticField, cameras: Sequence[Camera]) -> Evidence:
    """Look at a field with a codebook from each camera once.

    Each pixel's codeword is found as `segment(decode="latent")` and `query(cameras=...)` find it.
    """
    assert field.codebook is not None
    codewords = field.codebook.codewords.detach()
    centres = None if field.autoencoder is None else field.autoencoder.encode(codewords).detach()
    sums = torch.zeros(len(field), len(codewords)).to(field.features)
    weights = torch.zeros(len(field)).to(field.features)
    with torch.no_grad():
        for camera in cameras:
            rendering = field.render(camera)
            pixels, drawn = rendering.map.flatten(0, 1), rendering.alpha > 0
            if centres is None:
                shown = torch.cat([field.codebook.quantize(part) for part in pixels.split(CHUNK)])
            else:
                shown = nearest_codeword(pixels, centres.to(pixels))
            for index, columns, total, weight in _walks(field.gaussians, camera, shown.view(camera.size), drawn):
                sums[:, columns] = sums[:, columns].index_add_(0, index, total)
                if weight is not None:
                    weights.index_add_(0, index, weight)
    return Evidence(sums, weights, codewords)


def _walks(
    gaussians: Gaussians, camera: Camera, shown: Tensor, drawn: Tensor
) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor | None]]:
    """One view's sums for the codewords that it shows, some of them at a time; the weights come with the first."""
    projected = project(gaussians, camera)
    tiles = bin_tiles(projected, camera.width, camera.height)
    present = shown[drawn].unique()
    at_once = max(8, SIGNAL // max(1, camera.width * camera.height))
    for number, columns in enumerate(present.split(at_once)):
        signal = ((shown[..., None] == columns) & drawn[..., None]).to(projected.means2d)
        shape = projected.means2d, projected.conics, projected.opacities
        total, weight = accumulate_pixels(*shape, signal, tiles)
        yield projected.index, columns, total, weight if number == 0 else None
