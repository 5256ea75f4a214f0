"""Tables, chairs and an odd class in three heaps, in both clouds, for the tests of the viewer."""

import numpy as np
import torch

from kfgs.gaussians import Gaussians
from kfgs.viewer import Exploration, SplatMeaning

NAMES = ("table", "chair", "<b>{{ 1 + 1 }}</b>")  # the last must stay words
TABLE, CHAIR, ODD = range(3)


def _cloud(count, spread, seed, labels=None):
    """As many Gaussians around each of three places, far from each other."""
    generator = torch.Generator().manual_seed(seed)
    places = torch.tensor([[2.0, 0, 0], [-2.0, 0, 0], [0, 2.5, 0]]).repeat_interleave(count, dim=0)
    offsets = torch.randn(3 * count, 3, generator=generator)
    means = places + spread * offsets / offsets.norm(dim=1, keepdim=True)
    n = len(means)
    return Gaussians(
        means=means,
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        scales=torch.full((n, 3), 0.08),
        opacities=torch.full((n,), 0.9),
        sh=torch.rand(n, 1, 3, generator=generator),
        labels=None if labels is None else torch.arange(3).repeat_interleave(count),
    )


def exploration(names=NAMES):
    """Semantic Gaussians on spheres of radius 0.3, colour ones on spheres of 0.6: some are within 0.32, all within 1."""
    semantic = _cloud(60, 0.3, 1, labels=True)
    score = np.linspace(0.05, 0.95, len(semantic), dtype=np.float32)
    file = semantic.replace(scores=score, names=names)
    return Exploration(SplatMeaning(file), _cloud(150, 0.6, 2), distance=0.4)
