"""What a field knows about each Gaussian, gathered once, so that every later question is a small matrix product.

Three kinds: each Gaussian's own latent (Sec. 3.4), which codewords the pixels of some views show where it is seen, and, of
a field without codebook, the cosines of these pixels themselves. Each agrees with what `SemanticField` answers one question
at a time (`classify`, `classify_by_views`, `query`), up to rounding.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor

from ...cameras import Camera
from ...labels import average_views, classify, label_codewords, nearest_codeword
from ...labels._rows import unit_embeddings
from ...labels.vote import MIN_SHARE
from ...quant.codebook import EPS, row_norms, unit_rows
from ...splat import accumulate_pixels, bin_tiles, project

if TYPE_CHECKING:
    from ...fields import SemanticField
    from ...gaussians import Gaussians

CHUNK = 8192  # latents or pixels decoded or quantised at once, as in SemanticField
SIGNAL = 1 << 26  # numbers: a signal [H, W, channels] of at most 268 MB at a time


class Evidence(Protocol):
    """What is known about N Gaussians."""

    def labels(
        self,
        embeddings: Tensor,  # [C, D]
    ) -> tuple[Tensor, Tensor]:  # [N] int64, [N]
        """The class of each Gaussian, -1 = none, and a score of it."""
        ...

    def cosines(
        self,
        rows: Tensor,  # [M, D]
    ) -> tuple[Tensor, Tensor]:  # [N, M], [N] bool
        """The cosine of each Gaussian with some rows, and of which Gaussians anything is known; 0 of the others."""
        ...


@dataclass(frozen=True, eq=False)
class OwnFeatures:
    """Each Gaussian's own feature: one of K codewords, or one each where there is no codebook."""

    rows: Tensor  # [K, D] codewords, or [N, D] features
    index: Tensor  # [N] int64, a row for each Gaussian
    learnt: Tensor  # [N] bool: its latent left its start at 0

    @staticmethod
    def of(field: SemanticField) -> OwnFeatures:
        """Decode and quantise each Gaussian's latent, as `SemanticField.classify` does."""
        latents = field.features.detach()
        learnt = latents.any(dim=1)
        if field.codebook is None:
            return OwnFeatures(latents, torch.arange(len(latents), device=latents.device), learnt)
        index = [field.codebook.quantize(field.decode(part)) for part in latents.split(CHUNK)]
        return OwnFeatures(field.codebook.codewords.detach(), torch.cat(index), learnt)

    def labels(self, embeddings: Tensor) -> tuple[Tensor, Tensor]:
        """As `SemanticField.classify`: the scores are cosines."""
        found = classify(self.rows, embeddings)
        return found.labels[self.index].masked_fill(~self.learnt, -1), found.scores[self.index] * self.learnt

    def cosines(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """As `SemanticField.query` without cameras."""
        targets = unit_embeddings(rows, "embedding, negatives").to(self.rows).T
        values = torch.cat([unit_rows(part) @ targets for part in self.rows.split(CHUNK)])
        valid = self.learnt & (row_norms(self.rows) > EPS)[self.index]
        return values[self.index] * valid[:, None], valid


@dataclass(frozen=True, eq=False)
class SeenCodewords:
    """How much of each codeword the pixels show where a Gaussian is seen: any words can be asked of it."""

    sums: Tensor  # [N, K] rendering weight w = T alpha of each Gaussian on pixels of each codeword
    weights: Tensor  # [N] w on all pixels
    codewords: Tensor  # [K, D]

    @staticmethod
    def of(field: SemanticField, cameras: Sequence[Camera]) -> SeenCodewords:
        """Look at a field with a codebook from each camera once."""
        assert field.codebook is not None
        codewords = field.codebook.codewords.detach()
        with torch.no_grad():
            centres = None if field.autoencoder is None else field.autoencoder.encode(codewords)
            sums = torch.zeros(len(field), len(codewords)).to(field.features)
            weights = torch.zeros(len(field)).to(field.features)
            for camera in cameras:
                rendering = field.render(camera)
                parts = rendering.map.flatten(0, 1).split(CHUNK)
                if centres is None:
                    found = [field.codebook.quantize(part) for part in parts]
                else:
                    found = [nearest_codeword(part, centres.to(part)) for part in parts]
                shown = torch.cat(found).view(camera.size).masked_fill(rendering.alpha <= 0, -1)
                for index, columns, total, weight in _walks(field.gaussians, camera, shown):
                    sums[:, columns] = sums[:, columns].index_add_(0, index, total)
                    weights.index_add_(0, index, weight)
        return SeenCodewords(sums, weights, codewords)

    def labels(self, embeddings: Tensor) -> tuple[Tensor, Tensor]:
        """As `SemanticField.classify_by_views`: the scores are shares of the votes."""
        table = label_codewords(self.codewords, embeddings).labels.to(self.sums.device)
        votes = torch.zeros(len(self.sums), len(embeddings)).to(self.sums)
        votes.index_add_(1, table[table >= 0], self.sums[:, table >= 0])
        return _winners(votes)

    def cosines(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """As `SemanticField.query` with cameras."""
        targets = unit_embeddings(rows, "embedding, negatives").to(self.codewords).T
        values = self.sums @ (unit_rows(self.codewords) @ targets).to(self.sums)
        return values / _some(self.weights)[:, None], self.weights > 0


class SeenFeatures:
    """The mean cosine of the pixels where a Gaussian is seen, for rows known beforehand; others cost a pass each."""

    def __init__(self, field: SemanticField, cameras: Sequence[Camera], embeddings: Tensor, others: Tensor) -> None:
        """Look at a field without codebook from each camera once.

        Args:
            field: without codebook.
            cameras: views without distortion.
            embeddings: the classes' [C, D], which vote.
            others: [M, D] more rows that will be asked for.
        """
        self._field, self._cameras = field, cameras
        self._rows = torch.cat([embeddings, others])
        classes = len(embeddings)

        def views() -> Iterator[tuple[Camera, Tensor]]:
            for camera in cameras:
                cosines, drawn = self._cosine_map(camera, self._rows)
                best = cosines[..., :classes].argmax(dim=-1).masked_fill(~drawn, -1)
                votes = torch.nn.functional.one_hot(best + 1, classes + 1)[..., 1:]
                yield camera, torch.cat([votes.to(cosines), cosines], dim=-1)

        found = average_views(field.gaussians, views())
        self._votes, self._values = found.values[:, :classes], found.values[:, classes:]
        self._weights = found.weights

    def labels(self, embeddings: Tensor) -> tuple[Tensor, Tensor]:
        """As `SemanticField.classify_by_views`: the scores are shares of the votes."""
        return _winners(self._votes)

    def cosines(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """As `SemanticField.query` with cameras; rows that were never asked for are looked for in the views."""
        rows = rows.to(self._rows)
        same = (rows[:, None] == self._rows[None]).all(dim=-1)  # [M, known]
        new = rows[~same.any(dim=1)]
        if len(new):
            maps = ((camera, self._cosine_map(camera, new)[0]) for camera in self._cameras)
            self._values = torch.cat([self._values, average_views(self._field.gaussians, maps).values], dim=1)
            self._rows = torch.cat([self._rows, new])
            same = (rows[:, None] == self._rows[None]).all(dim=-1)
        return self._values[:, same.to(torch.uint8).argmax(dim=1)], self._weights > 0

    def _cosine_map(self, camera: Camera, rows: Tensor) -> tuple[Tensor, Tensor]:  # [H, W, M], [H, W] bool
        """The cosine of each pixel with some rows, 0 where it shows nothing; and where it shows something."""
        rendering = self._field.render(camera)
        pixels = rendering.map.flatten(0, 1)
        targets = unit_embeddings(rows, "embedding, negatives").to(pixels).T
        cosines = torch.cat([unit_rows(part) @ targets for part in pixels.split(CHUNK)])
        drawn = (rendering.alpha > 0) & (row_norms(pixels) > EPS).view(camera.size)
        return cosines.view(*camera.size, len(rows)) * drawn[..., None], drawn


def _walks(
    gaussians: Gaussians,
    camera: Camera,
    shown: Tensor,  # [H, W] int64, -1 = none
) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:  # [M] int64, [k] int64, [M, k], [M]
    """One view's Gaussians, some codewords that it shows, their sums, and the weights (with the first of them, else 0)."""
    projected = project(gaussians, camera)
    tiles = bin_tiles(projected, camera.width, camera.height)
    shape = projected.means2d, projected.conics, projected.opacities
    at_once = max(8, SIGNAL // (camera.width * camera.height))
    present = shown[shown >= 0].unique()
    for start in range(0, len(present), at_once):
        columns = present[start : start + at_once]
        column = torch.searchsorted(columns, shown).clamp_max(len(columns) - 1)
        signal = torch.zeros(*shown.shape, len(columns)).to(projected.means2d)
        signal.scatter_(-1, column[..., None], (columns[column] == shown)[..., None].to(signal))
        total, weight = accumulate_pixels(*shape, signal, tiles)
        yield projected.index, columns, total, weight if start == 0 else torch.zeros_like(weight)


def _winners(votes: Tensor) -> tuple[Tensor, Tensor]:  # [N, C] -> [N] int64, [N]
    """The class with most votes and its share, none where views disagree, as `vote_labels` has it."""
    cast = votes.sum(dim=1)
    best, labels = votes.max(dim=1)
    shares = best / _some(cast)
    return torch.where((cast > 0) & (shares >= MIN_SHARE), labels, -1), shares


def _some(weights: Tensor) -> Tensor:
    return weights.clamp_min(torch.finfo(weights.dtype).tiny)
