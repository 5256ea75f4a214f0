"""Small scenes of blobs, one for each thing, whose Gaussians have nearly the text embedding of their class."""

import torch

from kfgs import Camera, Gaussians
from kfgs.fields import Linear, SemanticField
from kfgs.labels import LabelSet
from kfgs.quant.linear import fit_linear_latents

DIM = 24
NAMES = ("wall", "chair", "table", "lamp", "boat")
PLACES = {"wall": 0.0, "chair": 2.0, "table": 4.0, "lamp": 6.0, "boat": 6.1}  # lamp and boat touch
COUNT = 60


def table(names=NAMES, **changes):
    """Classes with one embedding each, the same in every table. All share a part, which the canonical words consist of."""
    rows = torch.linalg.qr(torch.randn(DIM, DIM, generator=torch.Generator().manual_seed(7))).Q
    rows[:-2] = (rows[:-2] + 0.5 * rows[-1]) / 1.25**0.5
    kept: dict[str, object] = {"info": {"teacher": {"name": "toy"}}}
    kept |= {"negatives": torch.stack([rows[-1], rows[-1] + 0.2 * rows[-2]]), "negative_names": ("object", "things")}
    return LabelSet(names, torch.stack([rows[NAMES.index(name)] for name in names]), **kept | changes)


def scene(things, seed=0, words=None, teacher="toy", noise=0.05):
    """A field with one blob of 60 Gaussians for each (class, height); the last three Gaussians are in no view's pixels."""
    g = torch.Generator().manual_seed(seed)
    rows = table().embeddings
    means = torch.cat([torch.tensor([PLACES[n], 0.0, z]) + 0.2 * torch.rand(COUNT, 3, generator=g) for n, z in things])
    features = torch.cat([rows[NAMES.index(n)].expand(COUNT, -1) for n, _ in things])
    features = features + noise * torch.randn(features.shape, generator=g)
    linear = fit_linear_latents(features, keep=0.999)
    latents = linear.encode(features)
    latents[-3:] = 0
    N = len(means)
    cloud = Gaussians(means, torch.eye(4)[[0]].expand(N, 4).clone(), torch.full((N, 3), 0.05), torch.full((N,), 0.9),
                      features=latents)  # fmt: skip
    K = torch.tensor([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]])
    cameras = []
    for name in sorted({name for name, _ in things}, key=NAMES.index):
        pose = torch.eye(4)
        pose[:3, 3] = torch.tensor([-PLACES[name], 0.0, 3.0])
        cameras.append(Camera(pose, K, 40, 30, f"at the {name}"))
    info = {"teacher": {"name": teacher}}
    words = table(info=info) if words is None else words
    return SemanticField(cloud, Linear(linear.basis), tuple(cameras), words, info)
