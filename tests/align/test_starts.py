"""Starts for the alignment of clouds: rotations, thinning, and the improvement on a grid."""

import numpy as np
import pytest
from oracles_cameras import align_similarity
from scipy.spatial.transform import Rotation

from kfgs.align.starts import Moves, _fit, improve_on_grid, principal_axes, spread_rotations, thin


def test_rotations_leave_no_hole():
    spread = Rotation.from_matrix(spread_rotations(720))
    asked = Rotation.random(300, random_state=0)
    nearest = [float(np.degrees((spread * one.inv()).magnitude().min())) for one in asked]
    assert max(nearest) < 30
    assert np.median(nearest) < 18


def test_principal_axes_hold_the_true_rotation():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(500, 3)) * [3.0, 2.0, 1.0]
    true = Rotation.random(random_state=1)
    found = Rotation.from_matrix(principal_axes(x, true.apply(x)))
    assert np.degrees((found * true.inv()).magnitude().min()) < 1e-6
    assert np.allclose(np.linalg.det(found.as_matrix()), 1)


def test_thinning_evens_out_the_density():
    rng = np.random.default_rng(0)
    points = rng.random((10_000, 3))
    points[:1_000, 0] += 1  # one half nine times denser
    few = thin(points, 500, rng)
    assert 400 <= len(few) <= 500
    assert (few[:, 0] < 1).mean() == pytest.approx(0.5, abs=0.12)
    assert thin(points, 20_000, rng) is points


def test_one_step_with_exact_pairs_is_umeyamas():
    rng = np.random.default_rng(0)
    source = rng.normal(size=(4, 30, 3))
    turns = Rotation.random(4, random_state=2).as_matrix()
    target = 1.4 * source @ turns.transpose(0, 2, 1) + rng.normal(size=(4, 1, 3))
    found = _fit(source, target, np.ones((4, 30)))
    for k in range(4):
        scale, rotation, translation = align_similarity(source[k], target[k])
        assert found.scales[k] == pytest.approx(scale)
        np.testing.assert_allclose(found.rotations[k], rotation, atol=1e-9)
        np.testing.assert_allclose(found.translations[k], translation, atol=1e-9)


def test_the_true_start_scores_best():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(1_000, 3)) * [1.2, 0.8, 0.3] / np.sqrt(1.2**2 + 0.8**2 + 0.3**2)
    x[:300] = x[:300] * 0.3 + [0.5, 0.4, 0.2]  # a lump: no symmetry
    true = Rotation.from_rotvec([0.3, -0.5, 1.1]).as_matrix()
    starts = np.concatenate([spread_rotations(40), Rotation.from_rotvec([0.35, -0.45, 1.0]).as_matrix()[None]])
    moves, scores = improve_on_grid(x, x @ true.T, Moves.of(starts, (1.0,)), 400, rng)
    best = int(scores.argmax())
    left = Rotation.from_matrix(moves.rotations[best] @ true.T)
    assert np.degrees(left.magnitude()) < 5
    assert moves.scales[best] == pytest.approx(1, abs=0.05)
