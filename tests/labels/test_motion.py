import numpy as np
import pytest
import torch
from cases_clouds import random_cloud
from messages import refused
from oracles_selection import rotation

from kfgs.labels import Duplicate, Move
from kfgs.splat.covariance import covariance_3d
from kfgs.splat.sh import evaluate_sh

MOTIONS = (
    {"translation": (1.0, -2.0, 0.5)},
    {"rotation": ("z", 90)},
    {"rotation": ((1.0, 2.0, -1.0), 33.0), "scale": 0.5, "pivot": (1.0, 1.0, 0.0)},
    {"rotation": ((0.2, -0.4, 0.8), -200.0), "scale": 3.0, "translation": (0.1, 0.2, 0.3)},
)


def scene(n=10):
    made = random_cloud(n, 16, seed=1, dtype=torch.float64, labels=torch.arange(n) % 2, names=("wall", "chair"))
    quats, scores = made.quats - 0.5, torch.linspace(0.2, 1, n)
    return made.replace(means=2 * made.means, quats=quats, scales=0.2 * made.scales, sh=made.sh - 0.5, scores=scores)


@pytest.mark.parametrize("motion", MOTIONS)
def test_move_against_the_equation(motion):
    splats = scene()
    g, mask = splats, splats.labels == 1
    moved = Move("chair", **motion).apply(splats)
    assert moved[~mask].means.equal(g[~mask].means)
    assert moved[~mask].sh.equal(g[~mask].sh)
    assert moved.labels.equal(g.labels)
    axis, degrees = motion.get("rotation", ("z", 0))
    R, s = rotation((0, 0, 1) if axis == "z" else axis, degrees), motion.get("scale", 1.0)
    x, o = g.means[mask].numpy(), g.opacities[mask].numpy()
    pivot = motion.get("pivot", (o[:, None] * x).sum(0) / o.sum())
    expected = s * (x - pivot) @ R.T + pivot + np.array(motion.get("translation", (0, 0, 0)))
    np.testing.assert_allclose(moved.means[mask].numpy(), expected, atol=1e-12)
    before, after = (covariance_3d(c.quats[mask], c.scales[mask]).numpy() for c in (g, moved))
    np.testing.assert_allclose(after, s * s * R @ before @ R.T, atol=1e-7)
    assert moved.opacities.equal(g.opacities)
    directions = torch.from_numpy(np.random.default_rng(0).normal(size=(5, 3)))
    turn = torch.from_numpy(R)
    torch.testing.assert_close(
        evaluate_sh(moved.sh[mask], directions @ turn.T), evaluate_sh(g.sh[mask], directions), atol=1e-6, rtol=0
    )


def test_duplicates_follow_the_originals_with_their_labels_and_columns():
    splats = scene()
    doubled = Duplicate("chair", (0, 0, 5), ("x", 30), 0.5).apply(splats)
    mask = splats.labels == 1
    assert len(doubled) == 15
    for name in ("means", "quats", "scales", "sh", "opacities", "labels"):
        assert getattr(doubled, name)[:10].equal(getattr(splats, name))
    moved = Move("chair", (0, 0, 5), ("x", 30), 0.5).apply(splats).select(mask)
    for name in ("means", "quats", "scales", "sh", "opacities", "labels"):
        torch.testing.assert_close(getattr(doubled, name)[10:], getattr(moved, name))
    assert doubled.scores[10:].tolist() == splats.scores[mask].tolist()
    assert doubled.names == splats.names


def test_wrong_input_is_named():
    refused(lambda: Move("a", (1, 2)), "translation:", "3 numbers", "got (1, 2)")
    refused(lambda: Move("a", scale=0), "scale:", "got 0")
    refused(lambda: Move("a", rotation=(1, 2, 3)), "rotation:", "('z', 90)", "got (1, 2, 3)")
    refused(lambda: Move("a", rotation="z"), "rotation:", "got 'z'")
    refused(lambda: Move("a", rotation=("w", 90)), "axis:", "3 numbers", "got 'w'")
    refused(lambda: Move("a", rotation=((0, 0, 0), 90)), "axis", "got (0, 0, 0)")
    refused(lambda: Move("a", rotation=("z", "90")), "degrees:", "got '90'", error=TypeError)
    refused(lambda: Duplicate("a", pivot="corner"), "pivot:", "3 numbers", "got 'corner'")


def test_the_centroid_of_what_is_invisible_is_the_plain_mean():
    splats = scene().replace(opacities=torch.zeros(10).double())
    moved, chair = Move("chair", rotation=("z", 90), scale=2.0).apply(splats), splats.labels == 1
    torch.testing.assert_close(moved.means[chair].mean(dim=0), splats.means[chair].mean(dim=0))


@pytest.mark.parametrize(
    "edit",
    [
        Move("chair", (1e39, 0, 0)),
        Move("chair", (0, 1e9, 0)),
        Move("chair", scale=1e200),
        Move("chair", scale=3, pivot=(1e38, 0, 3e38)),
        Move("chair", scale=1e-60),
        Duplicate("chair", (0, -1e39, 0)),
    ],
    ids=repr,
)
def test_what_leaves_the_range_of_float32_is_an_error(edit):
    splats = scene()
    splats = splats.to(torch.float32)
    refused(lambda: edit.apply(splats), "expected positions and scales that", "float32", "after scale", "less")
