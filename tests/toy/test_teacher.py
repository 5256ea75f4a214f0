import numpy as np
import pytest
import torch

from kfgs.toy.patterns import Noise
from kfgs.toy.render import render, walk_cameras
from kfgs.toy.room import CLASSES, GROUPS, build_room
from kfgs.toy.teacher import class_embeddings, teacher_features


def test_embeddings_are_unit_and_related_classes_are_closer():
    rows = class_embeddings(512, seed=0)
    assert rows.shape == (len(CLASSES), 512)
    assert rows.dtype == np.float32
    assert np.allclose(np.linalg.norm(rows, axis=1), 1.0, atol=1e-6)
    cosine = rows @ rows.T
    together = {(a, b) for g in GROUPS for a in g for b in g if a != b}
    related = [cosine[CLASSES.index(a), CLASSES.index(b)] for a, b in together]
    pairs = [(i, j) for i, a in enumerate(CLASSES) for j, b in enumerate(CLASSES) if i != j and (a, b) not in together]
    apart = [cosine[pair] for pair in pairs]
    assert 0.6 < np.median(apart) < 0.72
    assert np.median(related) > np.median(apart) + 0.04
    assert max(related) < 0.9


@pytest.fixture(scope="module")
def views():
    noise = Noise(np.random.default_rng([0, 3]))
    cameras, testing = walk_cameras(24, 12, (192, 256))
    solids = build_room(0)
    return [render(solids, noise, c) for c, test in zip(cameras, testing, strict=True) if test][::6]


def accuracy(features, labels, embeddings) -> float:
    scores = np.einsum("cd,dhw->chw", embeddings, np.asarray(features, np.float32))
    up = torch.nn.functional.interpolate(torch.from_numpy(scores)[None], size=labels.shape, mode="bilinear")[0]
    return float((up.argmax(0).numpy() == labels).mean())


def test_the_teacher_is_mostly_right_and_averaging_views_repairs_it(views):
    embeddings = class_embeddings(64, seed=0)
    (image, _, labels), rngs = views[0], map(np.random.default_rng, range(8))
    maps = [teacher_features(labels, image, embeddings, (48, 64), rng).astype(np.float32) for rng in rngs]
    single = [accuracy(m, labels, embeddings) for m in maps]
    assert 0.85 < np.mean(single) < 0.97
    mean = np.mean([m / np.linalg.norm(m, axis=0) for m in maps], axis=0)
    assert accuracy(mean, labels, embeddings) > max(single)


def test_teacher_miou_leaves_something_to_denoise(views):
    embeddings = class_embeddings(512, seed=0)
    C = len(CLASSES)
    counts = np.zeros((C, C))
    for k, (image, _, labels) in enumerate(views):
        features = teacher_features(labels, image, embeddings, (48, 64), np.random.default_rng(k))
        assert features.dtype == np.float16
        assert features.shape == (512, 48, 64)
        norms = np.linalg.norm(features.astype(np.float32), axis=0)
        assert 4.9 < norms.min() < norms.max() < 18.1
        assert norms.std() > 1.0  # un-normalised, as real encoders leave them
        scores = np.einsum("cd,dhw->chw", embeddings, features.astype(np.float32))
        scores = np.kron(scores.argmax(0), np.ones((4, 4), int))
        counts += np.bincount((labels.astype(int) * C + scores).ravel(), minlength=C * C).reshape(C, C)
    union = counts.sum(0) + counts.sum(1) - np.diag(counts)
    assert 0.74 < (np.diag(counts) / union).mean() < 0.9
