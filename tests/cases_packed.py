"""Random fields of every method with every part, and the true errors of one that was packed."""

import math

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from kfgs import Camera, Gaussians
from kfgs.fields import Seen, SemanticField
from kfgs.labels import LabelSet
from kfgs.quant import Autoencoder, Codebook, LinearLatents

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
    parts = {}
    if "adc" in method:
        parts["codebook"] = Codebook(torch.randn(7, DIM, generator=g) * torch.logspace(-2, 2, 7)[:, None])
    if method == "adc+sc":
        layers = [[(torch.randn(o, i, generator=g), torch.randn(o, generator=g)) for i, o in pairs]
                  for pairs in (((DIM, 8), (8, 4)), ((4, 8), (8, DIM)))]  # fmt: skip
        parts["autoencoder"] = Autoencoder(*(tuple(pairs) for pairs in layers), low=-0.5, high=0.75)
    if method == "fused":
        parts["linear"] = _basis(d, g)
    else:
        parts |= {"linear": _basis(6, g), "answers": torch.randn(n, 6, generator=g) * torch.rand(n, 1, generator=g)}
    pose = torch.eye(4)
    pose[:3, :3] = torch.from_numpy(Rotation.from_euler("xyz", [0.1, 0.5, 1.0]).as_matrix()).float()
    K = torch.tensor([[40.0, 0, 20], [0, 41, 8], [0, 0, 1]])
    words = LabelSet(
        ("wall", "rote Stühle"), torch.randn(2, DIM, generator=g) * 9, torch.randn(1, DIM, generator=g), ("object",),
        {"teacher": {"name": "toy"}},
    )  # fmt: skip
    return SemanticField(
        Gaussians(**cloud | changes),
        info={"method": method, "nested": {"a": [1, None]}},
        seen=Seen(torch.rand(n, generator=g) * 5000, torch.rand(n, generator=g)),
        cameras=(Camera(pose, K, 40, 16, "first"), Camera(torch.eye(4), K, 39, 16, "Zweite", near=0.01)),
        words=words,
        **parts,
    )


def assert_same(one, other):
    """Every part of two fields, bit for bit."""
    for name, value in vars(one.gaussians).items():
        found = getattr(other.gaussians, name)
        tensor = isinstance(value, torch.Tensor)
        assert value.dtype == found.dtype and torch.equal(value, found) if tensor else value == found, name
    for part in ("codebook", "autoencoder", "linear"):
        ours, theirs = getattr(one, part), getattr(other, part)
        assert (ours is None) == (theirs is None), part
        if ours is not None:
            pairs = ours.to_tensors(), theirs.to_tensors()
            assert list(pairs[0]) == list(pairs[1])
            assert all(torch.equal(pairs[0][name], pairs[1][name]) for name in pairs[0]), part
    assert (one.answers is None) == (other.answers is None)
    assert one.answers is None or torch.equal(one.answers, other.answers)
    assert all(torch.equal(a, b) for a, b in zip(one.seen, other.seen, strict=True))
    assert_same_notes(one, other)
    assert torch.equal(one.words.embeddings, other.words.embeddings)
    assert one.info == other.info


def assert_same_notes(one, other):
    """What no precision touches: cameras and names."""
    for a, b in zip(one.cameras, other.cameras, strict=True):
        assert (a.name, a.size, a.near) == (b.name, b.size, b.near)
        assert torch.equal(a.K, b.K)
        assert torch.equal(a.viewmat, b.viewmat)
    for name in ("names", "negative_names", "info"):
        assert getattr(one.words, name) == getattr(other.words, name)


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
    rows = (before.features, after.features) if made.answers is None else (made.answers[order], back.answers)
    if rows[0].numel():
        name = "gaussians.features" if made.answers is None else "answers.latents"
        close(*rows, errors[name])
        close(before.features, after.features, errors["gaussians.features"])
    assert torch.equal(made.known[order], back.known)
    pixels, agreement = (value[order] for value in made.seen)
    assert ((pixels - back.seen.pixels).abs() <= (errors["seen.pixels"] + EPS) * (pixels + 1)).all()
    close(agreement, back.seen.agreement, errors["seen.agreement"])
    for ours, theirs, name in _decoders(made, back):
        rms = ours.double().square().mean(1, keepdim=True).sqrt()
        assert ((ours - theirs).abs() <= (errors[name] + EPS) * rms).all(), name


def _decoders(made, back):
    yield made.words.embeddings, back.words.embeddings, "words.embeddings"
    if made.words.negatives is not None:
        yield made.words.negatives, back.words.negatives, "words.negatives"
    if made.codebook is not None:
        yield made.codebook.codewords, back.codebook.codewords, "codebook.codewords"
    if made.autoencoder is not None:
        pairs = made.autoencoder.to_tensors(), back.autoencoder.to_tensors()
        for name in pairs[0]:
            if name.endswith("weight"):
                yield pairs[0][name], pairs[1][name], f"autoencoder.{name}"
            else:
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
