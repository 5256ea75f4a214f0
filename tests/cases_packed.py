"""Random fields of every method with every part, and the true errors of one that was packed."""

import math

import numpy as np
import torch
from cases_quant import made_autoencoder
from scipy.spatial.transform import Rotation

from kfgs import Camera, Gaussians
from kfgs.fields import Autoencoded, Codewords, Identity, Linear, SemanticField
from kfgs.labels import LabelSet
from kfgs.quant import Codebook, LinearLatents

DIM = 24
METHODS = ["fused", "decouple", "adc", "adc+sc"]
LOSSY = ["fine", "small", "tiny"]
EPS = 3e-6  # float32, a few roundings


def _basis(d, g):
    return LinearLatents(torch.linalg.qr(torch.randn(DIM, d, generator=g).double()).Q.float())


def field(method="fused", n=300, seed=0, **changes):
    """Everything a field can hold; `labels` number the Gaussians, so that they are found again after sorting."""
    g = torch.Generator().manual_seed(seed)
    d = {"fused": 5, "adc+sc": 4}.get(method, DIM)
    features = torch.randn(n, d, generator=g)
    features[n // 2 :: 7] = 0  # nothing is known about these
    cloud = {
        "means": torch.randn(n, 3, generator=g) * torch.tensor([5.0, 1, 0.1]),
        "quats": torch.randn(n, 4, generator=g),
        "scales": torch.exp(torch.randn(n, 3, generator=g) - 3),
        "opacities": torch.rand(n, generator=g) * 0.98 + 0.01,
        "features": features,
        "labels": torch.arange(n),
        "antialiased": method == "fused",
    }
    decoder, fused = Identity(DIM), None
    if "adc" in method:
        codebook = Codebook(torch.randn(7, DIM, generator=g) * torch.logspace(-2, 2, 7)[:, None])
        decoder = Codewords(codebook)
    if method == "adc+sc":
        layers = [[(torch.randn(o, i, generator=g), torch.randn(o, generator=g)) for i, o in pairs]
                  for pairs in (((DIM, 8), (8, 4)), ((4, 8), (8, DIM)))]  # fmt: skip
        decoder = Autoencoded(codebook, made_autoencoder(*(tuple(pairs) for pairs in layers), low=-0.5, high=0.75))
    if method == "fused":
        decoder = Linear(_basis(d, g).basis)
    gaussians = Gaussians(**cloud | changes)
    if method != "fused":
        latents = torch.randn(n, 6, generator=g) * torch.rand(n, 1, generator=g)
        fused = SemanticField(gaussians.replace(features=latents), Linear(_basis(6, g).basis))
    pose = torch.eye(4)
    pose[:3, :3] = torch.from_numpy(Rotation.from_euler("xyz", [0.1, 0.5, 1.0]).as_matrix()).float()
    K = torch.tensor([[40.0, 0, 20], [0, 41, 8], [0, 0, 1]])
    words = LabelSet(
        ("wall", "rote Stühle"), torch.randn(2, DIM, generator=g) * 9, torch.randn(1, DIM, generator=g), ("object",),
        {"teacher": {"name": "toy"}},
    )  # fmt: skip
    cameras = Camera(pose, K, 40, 16, "first"), Camera(torch.eye(4), K, 39, 16, "Zweite", near=0.01)
    info = {"method": method, "nested": {"a": [1, None]}}
    return SemanticField(gaussians, decoder, cameras, words, info, fused)


def assert_same(one, other):
    """Every part of two fields, bit for bit."""
    for name, value in vars(one.gaussians).items():
        found = getattr(other.gaussians, name)
        tensor = isinstance(value, torch.Tensor)
        assert value.dtype == found.dtype and torch.equal(value, found) if tensor else value == found, name
    assert type(one.decoder) is type(other.decoder)
    ours, theirs = one.decoder.to_tensors(), other.decoder.to_tensors()
    assert list(ours) == list(theirs)
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    assert (one.fused is None) == (other.fused is None)
    assert one.fused is None or torch.equal(one.fused.latents, other.fused.latents)
    assert_same_notes(one, other)
    assert torch.equal(one.classes.embeddings, other.classes.embeddings)
    assert one.info == other.info


def assert_same_notes(one, other):
    """What no precision touches: cameras and names."""
    for a, b in zip(one.cameras, other.cameras, strict=True):
        assert (a.name, a.size, a.near) == (b.name, b.size, b.near)
        assert torch.equal(a.K, b.K)
        assert torch.equal(a.viewmat, b.viewmat)
    for name in ("names", "negative_names", "info"):
        assert getattr(one.classes, name) == getattr(other.classes, name)


def assert_within(made, back):
    """The errors that a packed field states are true, and its Gaussians are those of the field, in another order."""
    errors = back.info["rounded"][-1]["errors"]
    order = back.gaussians.labels
    assert sorted(order.tolist()) == list(range(len(made)))
    before, after = made.gaussians[order], back.gaussians
    if len(made) == 0:
        return
    close(before.means, after.means, errors["gaussians.means"])
    close(before.opacities, after.opacities, errors["gaussians.opacities"] + 1e-4)
    assert 0 < float(after.opacities.min()) <= float(after.opacities.max()) < 1
    assert_ellipsoids(before, after, errors)
    if before.features.numel():
        if made.fused is not None:
            close(made.fused.latents[order], back.fused.latents, errors["fused.latents"])
        close(before.features, after.features, errors["gaussians.features"])
    assert torch.equal(made.known[order], back.known)
    for ours, theirs, name in _decoders(made, back):
        rms = ours.double().square().mean(1, keepdim=True).sqrt()
        assert ((ours - theirs).abs() <= (errors[name] + EPS) * rms).all(), name


def _decoders(made, back):
    yield made.classes.embeddings, back.classes.embeddings, "classes.embeddings"
    yield made.classes.negatives, back.classes.negatives, "classes.negatives"
    pairs = made.decoder.to_tensors(), back.decoder.to_tensors()
    for name in pairs[0]:
        if name.endswith("weight") or name == "codebook.codewords":
            yield pairs[0][name], pairs[1][name], name
        elif name != "linear.basis":
            assert torch.equal(pairs[0][name], pairs[1][name])


def close(one, other, error):
    one, other = one.double(), other.double()
    assert ((one - other).abs() <= error * (1 + 1e-6) + EPS * one.abs().max()).all(), (one - other).abs().max()


def assert_ellipsoids(before, after, errors):
    """For one of the 24 names of the axes, rotation and scales are within their errors."""
    share, grid = errors["gaussians.scales"], 2 * errors["gaussians.means"]
    norms = before.quats.norm(dim=1, keepdim=True)
    quats = torch.where(norms > 0, before.quats / norms.clamp_min(1e-30), torch.tensor([1.0, 0, 0, 0]))
    R, S = (Rotation.from_quat(np.roll(one.double().numpy(), -1, axis=1)) for one in (quats, after.quats))
    fits = np.zeros(len(before), bool)
    for turn in Rotation.create_group("O"):
        axes = np.abs(turn.as_matrix()).argmax(0)
        scales = before.scales.double().numpy()[:, axes]
        apart = np.abs(scales - after.scales.double().numpy()) <= (share + EPS) * (scales + grid) * 1.0001
        near = (S.inv() * R * turn).magnitude() <= math.radians(errors["gaussians.quats"]) + 1e-5
        fits |= near & apart.all(1)
    assert fits.all(), np.flatnonzero(~fits)[:5]
