"""LangSplatV2 (NeurIPS 2025): each Gaussian mixes 4 of 64 features that the whole scene shares.

Logits become weights by softmax; the 4 largest are kept and sum to 1. Weights are splatted, 64 channels, and the features are
looked up per pixel. Logits that are not among the 4 get no gradient, so which codes a Gaussian takes is a search by trial.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from kfgs._rows import unit_rows
from kfgs.quant.grow import spherical_kmeans

from .common import FLOAT, Clock, Fitted, KeptMaps, Task, is_shown, sample_rows
from .langsplat import nearest
from .methods import LinearDecoder, RenderedMethod
from .trainer import Schedule, adam, train

CODES, KEPT = 64, 4
NORM_EPS = 1e-10  # added to the sum of the weights that are kept
START = 1e-3
"""Size of the random first logits. Published is zero, where the choice of the 4 depends on how ties are broken."""


@dataclass(frozen=True)
class LangSplatV2Config:
    """The published values, or fewer steps."""

    steps: int = 10_000
    rate: float = 2.5e-3
    """Of logits."""
    rows: int = 200_000
    """Most features that the first codes are the means of."""
    pixels: int | None = None
    code_rate: float = 2.5e-3
    """Of codes. They have unit length, so that a step at a higher rate replaces the means they start from."""

    @staticmethod
    def published() -> LangSplatV2Config:
        """10,000 steps at the pictures' size."""
        return LangSplatV2Config()

    @staticmethod
    def short() -> LangSplatV2Config:
        """For two cores: 400 steps of 20,000 pixels, 20 times the rate of logits."""
        return LangSplatV2Config(400, 5e-2, 30_000, 20_000)

    @staticmethod
    def medium() -> LangSplatV2Config:
        """For an hour: 600 steps of 40,000 pixels, 16 times the rate of logits."""
        return LangSplatV2Config(600, 4e-2, 60_000, 40_000)


def sparse_weights(logits: Tensor, kept: int = KEPT) -> Tensor:  # [N, K] -> [N, K]
    """Softmax, its largest values, divided by their sum; the others are 0."""
    values, index = logits.softmax(dim=1).topk(kept, dim=1)
    values = values / (values.sum(dim=1, keepdim=True) + NORM_EPS)
    return torch.zeros_like(logits).scatter(1, index, values)


def cosine_loss(found: Tensor, wanted: Tensor, known: Tensor) -> Tensor:  # [..., D], [..., D], [...] bool -> []
    """1 - mean cosine over all pixels; an unknown one has cosine 0."""
    return 1 - ((unit_rows(found) * unit_rows(wanted)).sum(dim=-1) * known).mean()


class Mixtures(torch.nn.Module):
    """Logits of each Gaussian, and the codes."""

    def __init__(self, gaussians: int, codes: Tensor, config: LangSplatV2Config, generator: torch.Generator) -> None:
        super().__init__()
        self.logits = torch.nn.Parameter(START * torch.randn(gaussians, len(codes), generator=generator))
        self.codes = torch.nn.Parameter(codes.clone())
        self.optimizers = [adam([self.logits], config.rate), adam([self.codes], config.code_rate)]

    def splatted(self) -> Tensor:  # [N, K]
        """The sparse weights."""
        return sparse_weights(self.logits)

    def loss(self, rendered: Tensor, target: Tensor, step: int) -> Tensor:  # [H, W, K], [h, w, D] -> []
        """Each pixel has the feature of the cell that it lies in."""
        wanted = nearest(target, rendered)
        return cosine_loss(rendered @ self.codes, wanted, wanted.any(dim=-1))


def storage_bytes(gaussians: int, codes: int, channels: int, levels: int = 1) -> int:
    """A weight in float32 and an index of 1 byte for each of 4 codes and each level, and the codes in float32.

    On disk the weights are half precision, as a viewer would keep them.
    """
    return levels * (gaussians * KEPT * (FLOAT + 1) + FLOAT * codes * channels)


def fit(task: Task, config: LangSplatV2Config) -> Fitted:
    """Cluster the features, then learn mixtures on a frozen cloud: one level."""
    clock, frozen, maps, generator = Clock(), task.frozen, KeptMaps(task.maps), task.generator()
    with clock.stage("codes"):
        rows = unit_rows(sample_rows(maps, config.rows, generator))
        codes = spherical_kmeans(rows, torch.ones(len(rows)), CODES, generator=generator)[0]
    model, schedule = Mixtures(len(frozen), codes, config, generator), Schedule(config.steps, config.pixels)
    with clock.stage("mixtures"):
        history = train(frozen, task.cameras, maps, model, schedule, generator=generator, progress=task.progress)
    own, codes = model.splatted().detach(), model.codes.detach()
    weights, index = own.topk(min(KEPT, own.shape[1]), dim=1)
    tensors = {"weights": weights.half(), "indices": index.to(torch.uint8), "codes": codes}
    known = is_shown(frozen, task.cameras)
    method = RenderedMethod("LangSplatV2", frozen.replace(features=own), LinearDecoder(codes.T.contiguous()), known)
    storage = storage_bytes(len(frozen), *codes.shape)
    return Fitted(method, f"{KEPT} of {len(codes)}", storage, tensors, clock.seconds, history)
