"""A simulated teacher: dense features for views whose labels are known, and the class embeddings they are made of.

It imitates the errors of a real open-vocabulary encoder, independently in each view: whole regions drift towards a related
class, borders are soft, confusion comes in smooth patches, the features follow colour and texture, there is white noise, and
the norm varies by pixel. Views disagree about all of this. Distillation into one 3-D field and clustering repair it. Scores on
this simulation say how well a pipeline removes noise, and nothing about a real encoder.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from .room import CLASSES, GROUPS

Floats = NDArray[np.float32]

SHARED = 0.66  # squared share of the mean direction: the cosine of unrelated classes, as CLIP text embeddings have
RELATED = 0.12  # squared share of the group directions, divided among a class's groups
DRIFT = 0.16  # probability that a region of one view drifts
SHARPNESS = 5.0  # of the softmax over class evidence
BORDER = 0.5  # pixels of the map, standard deviation of the softness of borders
CONFUSION = 0.18  # standard deviation of the smooth confusion fields, in units of evidence
APPEARANCE = 0.22  # how strongly colour and edges leak into the feature
WHITE = 0.28  # norm of the white noise, of a feature of norm about 1


def _unit(rows: NDArray[np.floating]) -> Floats:
    return (rows / np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), 1e-8)).astype(np.float32)


def class_embeddings(feature_dim: int, seed: int) -> Floats:  # [C, D] unit rows
    """One embedding per class: a direction shared by all, directions shared within groups, and a direction of the class alone."""
    rng = np.random.default_rng([seed, 2])
    shared = _unit(rng.standard_normal(feature_dim))
    groups = _unit(rng.standard_normal((len(GROUPS), feature_dim)))
    own = _unit(rng.standard_normal((len(CLASSES), feature_dim)))
    rows = []
    for c, name in enumerate(CLASSES):
        common = SHARED + float(rng.uniform(-0.04, 0.04))
        member = sum(groups[g] for g, names in enumerate(GROUPS) if name in names)
        rows.append(np.sqrt(common) * shared + np.sqrt(RELATED) * _unit(member) + np.sqrt(0.88 - common) * own[c])
    return _unit(np.stack(rows))


def _field(rng: np.random.Generator, shape: tuple[int, ...], sigma: float) -> Floats:
    """Smooth Gaussian noise of about unit variance, correlated over `sigma` pixels in its last two axes."""
    noise = ndimage.gaussian_filter(rng.standard_normal(shape).astype(np.float32), sigma, mode="wrap", axes=(-2, -1))
    return noise / max(float(noise.std()), 1e-6)


def teacher_features(
    labels: NDArray[np.uint8],  # [H, W] class index
    image: NDArray[np.uint8],  # [H, W, 3]
    embeddings: Floats,  # [C, D]
    size: tuple[int, int],  # (h, w)
    rng: np.random.Generator,
) -> NDArray[np.float16]:  # [D, h, w]
    """The feature map of one view, in the axis order of Feature-3DGS; `rng` decides all errors of the view."""
    (h, w), (C, D) = size, embeddings.shape
    pixel = w / 64.0  # lengths are given for a map 64 wide
    seen = np.concatenate([np.eye(C)[labels], image / 255.0], axis=-1, dtype=np.float32).transpose(2, 0, 1)
    cells = torch.nn.functional.interpolate(torch.from_numpy(seen)[None], size=size, mode="area")[0].numpy()
    evidence, colors = cells[:C].copy(), cells[C:]  # evidence for a class is its share of the cell
    winner, similarity = evidence.argmax(0), embeddings @ embeddings.T - 2 * np.eye(C)
    for c in np.unique(winner):
        regions, count = ndimage.label(winner == c)
        for region in range(1, count + 1):
            drifts, other = rng.random() < DRIFT, int(rng.choice(np.argsort(-similarity[c])[:3]))
            amount, patch = rng.uniform(0.5, 1.15), _field(rng, (h, w), 5.0 * pixel)
            if drifts:
                evidence[other] += amount * ((regions == region) & (patch > -0.4))
    evidence = ndimage.gaussian_filter(evidence, (0, BORDER, BORDER)) + CONFUSION * _field(rng, (C, h, w), 2.7 * pixel)
    weights = np.exp(SHARPNESS * (evidence - evidence.max(0)))
    weights /= weights.sum(0)

    mean = embeddings.mean(0)
    features = 0.75 * np.tensordot(weights, _unit(embeddings - mean), axes=(0, 0)) + 0.55 * _unit(mean)  # [h, w, D]
    gray = colors.mean(0)
    edges = np.hypot(ndimage.sobel(gray, 0), ndimage.sobel(gray, 1))
    appearance = np.stack([*(colors - 0.5), edges, ndimage.gaussian_filter(gray, 2 * pixel) - 0.5])
    basis = _unit(np.random.default_rng(1234).standard_normal((len(appearance), D)))  # the same in every view
    features = features + APPEARANCE * np.tensordot(appearance, basis, axes=(0, 0))
    features = features + WHITE / np.sqrt(D) * rng.standard_normal((h, w, D), dtype=np.float32)
    norm = np.clip(11.0 + 2.0 * _field(rng, (h, w), 3.0 * pixel), 5.0, 18.0)
    return np.ascontiguousarray((_unit(features) * norm[..., None]).transpose(2, 0, 1).astype(np.float16))
