"""A small field, classes and views to ask, and clouds whose positions tie, for the tests of the explorer."""

from functools import cache

import numpy as np
import torch
from cases_clouds import balls as cloud
from cases_quant import first_channels

from kfgs._rows import unit_rows
from kfgs.cameras import Camera
from kfgs.fields import Autoencoded, Codewords, Identity, Linear, SemanticField
from kfgs.gaussians import Gaussians
from kfgs.labels import LabelSet
from kfgs.quant.codebook import Codebook
from kfgs.quant.linear import fit_linear_latents
from kfgs.splat.sh import rgb_to_sh0
from kfgs.viewer.meaning import FieldMeaning, SplatMeaning
from kfgs.viewer.state import Exploration

DIM, WORDS = 16, 12
NAMES = ("wall", "chair", "table", "office chair")
LINE = [[float(i), 0, 5] for i in range(4)]


@cache
def codebook():
    """Twelve codewords of different lengths, nearly orthogonal."""
    generator = torch.Generator().manual_seed(1)
    rows = torch.eye(WORDS, DIM) + 0.2 * torch.rand(WORDS, DIM, generator=generator)
    return Codebook(rows * torch.linspace(0.5, 2, WORDS)[:, None])


@cache
def autoencoder():
    return first_channels(WORDS, DIM)


@cache
def linear():
    """Twelve latents that hold every codeword."""
    made = fit_linear_latents(codebook().unit, keep=1.0)
    assert made.latent == WORDS
    return made


def field(mode="adc+sc", n=80, seed=0):
    """Gaussians that overlap, near codewords; two that were never learnt, one that no view shows.

    As trained by one of the paper's rows, or "fused": with linear latents, of different lengths.
    """
    generator = torch.Generator().manual_seed(seed)
    rand = lambda *shape: torch.rand(*shape, generator=generator)  # noqa: E731
    features = codebook().codewords[torch.arange(n) % WORDS] + 0.05 * rand(n, DIM)
    if mode == "adc+sc":
        with torch.no_grad():
            features = autoencoder().encode(features)
    if mode == "fused":
        features = linear().encode(unit_rows(features) * torch.linspace(0.5, 1, n)[:, None])
    features[:2] = 0
    means = torch.stack([rand(n) * 4 - 2, rand(n) * 2 - 1, rand(n) * 2 + 4], dim=1)
    means[2] = torch.tensor([0.0, 50.0, 5.0])
    gaussians = Gaussians(
        means=means,
        quats=torch.randn(n, 4, generator=generator),
        scales=rand(n, 3) * 0.1 + 0.05,
        opacities=rand(n) * 0.5 + 0.45,
        features=features,
    )
    if mode == "fused":
        return SemanticField(gaussians, Linear(linear().basis))
    if mode == "decouple":
        return SemanticField(gaussians, Identity(DIM))
    trained = Autoencoded(codebook(), autoencoder()) if mode == "adc+sc" else Codewords(codebook())
    return SemanticField(gaussians, trained)


def classes(count=4, negatives=True):
    """Classes like a codeword each, and two canonical words."""
    rows = codebook().codewords[:count] + 0.1
    others = codebook().codewords[[5, 6]] if negatives else None
    return LabelSet(NAMES[:count], rows, others, ("object", "stuff") if negatives else ())


def cameras(count=3):
    made = []
    for i in range(count):
        viewmat = torch.eye(4)
        viewmat[0, 3] = 0.3 * (i - (count - 1) / 2)
        K = torch.tensor([[40.0, 0, 21], [0, 44, 13], [0, 0, 1]])
        made.append(Camera(viewmat, K, 40, 28, f"view_{i}"))
    return made


def grid_clouds(seed=0, sources=150, targets=400):
    """Semantic and colour Gaussians on whole numbers, so that distances tie and several share a place."""
    generator = torch.Generator().manual_seed(seed)
    semantic = torch.randint(0, 7, (sources, 3), generator=generator).float()
    color = torch.randint(-2, 9, (targets, 3), generator=generator).float()
    labels = torch.randint(-1, 4, (sources,), generator=generator)
    features = torch.rand(sources, 5, generator=generator)
    sh = torch.rand(targets, 1, 3, generator=generator) - 0.5
    return cloud(semantic, labels, features=features), cloud(color, sh=sh)


def splat_file(gaussians, score=None):
    return gaussians.replace(scores=score, names=NAMES)


def grid(score=None, **options):
    """An exploration of clouds whose distances tie."""
    semantic, color = grid_clouds()
    return Exploration(SplatMeaning(splat_file(semantic, score)), color, **options)


def line(distance=1.0, **options):
    """Three semantic Gaussians on a line, a chair, a table and one of no class; five colour Gaussians beside it."""
    sh = rgb_to_sh0(torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0, 0, 0]]))[:, None]
    semantic = cloud([[0.0, 0, 5], [3, 0, 5], [6, 0, 5]], [1, 2, -1], features=torch.eye(3))
    color = cloud([[0.25, 0, 5], [1, 0, 5], [2.5, 0, 5], [6, 0, 5], [60, 0, 5]], sh=sh)
    made = SplatMeaning(splat_file(semantic, np.array([0.8, 0.6, 0.4], np.float32)))
    return Exploration(made, color, distance=distance, **options)


def room():
    """A fused field, its classes and views, and a colour cloud in its place."""
    generator = torch.Generator().manual_seed(2)
    means = torch.rand(60, 3, generator=generator) * 2 + torch.tensor([-1, -1, 4])
    color = cloud(means, sh=rgb_to_sh0(torch.rand(60, 3, generator=generator))[:, None])
    return Exploration(FieldMeaning(field("fused"), classes()), color, cameras=cameras(), distance=0.4)
