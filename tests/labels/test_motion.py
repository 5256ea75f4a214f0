import numpy as np
import pytest
import torch
from messages import tells

from kfgs import Gaussians
from kfgs.labels import Duplicate, Move
from kfgs.splat import covariance_3d, evaluate_sh

MOTIONS = (
    {"translation": (1.0, -2.0, 0.5)},
    {"rotation": ("z", 90)},
    {"rotation": ((1.0, 2.0, -1.0), 33.0), "scale": 0.5, "pivot": (1.0, 1.0, 0.0)},
    {"rotation": ((0.2, -0.4, 0.8), -200.0), "scale": 3.0, "translation": (0.1, 0.2, 0.3)},
)


def scene(n=10, seed=1):
    rng = np.random.default_rng(seed)
    draw = lambda *shape: torch.from_numpy(rng.uniform(0.1, 0.9, shape))  # noqa: E731
    gaussians = Gaussians(
        means=draw(n, 3) * 2,
        quats=draw(n, 4) - 0.5,
        scales=draw(n, 3) * 0.2,
        opacities=draw(n),
        sh=draw(n, 16, 3) - 0.5,
        labels=torch.arange(n) % 2,
    )
    return gaussians.replace(scores=rng.uniform(size=n), names=("wall", "chair"))


def oracle_matrix(motion):
    """The 3 x 3 matrix of a motion's rotation, by Rodrigues' formula in plain numpy."""
    axis, degrees = motion.get("rotation", ("z", 0))
    k, a = np.array((0, 0, 1) if axis == "z" else axis, float), np.deg2rad(degrees)
    k /= np.linalg.norm(k)
    K = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
    return np.eye(3) + np.sin(a) * K + (1 - np.cos(a)) * K @ K


@pytest.mark.parametrize("motion", MOTIONS)
def test_move_against_the_equation(motion):
    splats = scene()
    g, mask = splats, splats.labels == 1
    moved = Move("chair", **motion).apply(splats)
    R, s = oracle_matrix(motion), motion.get("scale", 1.0)
    x, o = g.means[mask].numpy(), g.opacities[mask].numpy()
    pivot = motion.get("pivot", (o[:, None] * x).sum(0) / o.sum())
    expected = s * (x - pivot) @ R.T + pivot + np.array(motion.get("translation", (0, 0, 0)))
    np.testing.assert_allclose(moved.means[mask].numpy(), expected, atol=1e-12)
    before, after = (covariance_3d(c.quats[mask], c.scales[mask]).numpy() for c in (g, moved))
    np.testing.assert_allclose(after, s * s * R @ before @ R.T, atol=1e-7)
    directions = torch.from_numpy(np.random.default_rng(0).normal(size=(5, 3)))
    turn = torch.from_numpy(R)
    torch.testing.assert_close(
        evaluate_sh(moved.sh[mask], directions @ turn.T), evaluate_sh(g.sh[mask], directions), atol=1e-6, rtol=0
    )


@pytest.mark.parametrize("motion", MOTIONS)
def test_move_leaves_the_rest_the_order_and_the_input(motion):
    splats = scene()
    copy = splats.means.clone()
    moved = Move("chair", **motion).apply(splats)
    rest = splats.labels == 0
    for name in ("means", "quats", "scales", "sh", "opacities"):
        assert getattr(moved, name)[rest].equal(getattr(splats, name)[rest])
    assert moved.labels.equal(splats.labels)
    assert moved.opacities.equal(splats.opacities)
    assert splats.means.equal(copy)


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


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: Move("a", (1, 2)), ValueError, ("translation:", "3 numbers", "got (1, 2)")),
        (lambda: Move("a", scale=0), ValueError, ("scale:", "got 0")),
        (lambda: Move("a", rotation=(1, 2, 3)), ValueError, ("rotation:", "('z', 90)", "got (1, 2, 3)")),
        (lambda: Move("a", rotation="z"), ValueError, ("rotation:", "got 'z'")),
        (lambda: Move("a", rotation=("w", 90)), ValueError, ("axis:", "3 numbers", "got 'w'")),
        (lambda: Move("a", rotation=((0, 0, 0), 90)), ValueError, ("axis", "got (0, 0, 0)")),
        (lambda: Move("a", rotation=("z", "90")), TypeError, ("degrees:", "got '90'")),
        (lambda: Duplicate("a", pivot="corner"), ValueError, ("pivot:", "3 numbers", "got 'corner'")),
    ],
)
def test_wrong_input_is_named(make, error, message):
    with pytest.raises(error, match=tells(*message)):
        make()


def test_the_centroid_of_what_is_invisible_is_the_plain_mean():
    splats = scene()
    moved = Move("chair", rotation=("z", 90), scale=2.0).apply(splats.replace(opacities=torch.zeros(10).double()))
    chair = splats.labels == 1
    torch.testing.assert_close(moved.means[chair].mean(dim=0), splats.means[chair].mean(dim=0))


@pytest.mark.parametrize(
    "edit",
    [
        Move("chair", (1e39, 0, 0)),
        Move("chair", (1e38, 0, 0)),
        Move("chair", (0, 1e9, 0)),
        Move("chair", scale=1e200),
        Move("chair", scale=1e30),
        Move("chair", scale=3, pivot=(1e38, 0, 3e38)),
        Move("chair", scale=1e-60),
        Duplicate("chair", (0, -1e39, 0)),
    ],
    ids=repr,
)
def test_what_leaves_the_range_of_float32_is_an_error(edit):
    splats = scene()
    splats = splats.to(torch.float32)
    with pytest.raises(ValueError, match=tells("expected positions and scales that", "float32", "after scale", "less")):
        edit.apply(splats)
