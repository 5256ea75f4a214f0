"""Two clouds of one scene, aligned by their shape alone."""

import numpy as np
import pytest
import torch
from cases_clouds import room
from messages import tells
from scipy.spatial.transform import Rotation

from kfgs.align import align_clouds
from kfgs.align import by_shape as register
from kfgs.cameras.similarity import Similarity
from kfgs.scenes import SceneError


def a_similarity(seed):
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=rng).as_matrix()
    shift = torch.from_numpy(10 * rng.normal(size=3))
    return Similarity(float(np.exp(rng.uniform(-2, 2))), torch.from_numpy(rotation), shift)


@pytest.mark.parametrize("seed", range(2))
def test_finds_rotation_scale_and_place(seed):
    true = a_similarity(seed)
    found = align_clouds(room(3_000, seed), true.apply(room(4_500, seed + 50, thinning=0.6, floaters=0.05)))
    left = true.inverse() @ found.similarity
    angle = np.degrees(Rotation.from_matrix(left.rotation.numpy()).magnitude())
    assert angle < 0.5
    assert left.scale == pytest.approx(1, abs=0.01)
    center = torch.tensor([[2.0, 1.5, 1.0]]).double()
    assert float((left.apply(center) - center).norm()) < 0.03  # of a room of 5.4 metres
    assert found.details["quality"] > found.details["best other fit"] + 0.1
    assert found.rms < 0.1 * true.scale


def test_equal_seeds_give_equal_results(monkeypatch):
    monkeypatch.setattr(register, "ROTATIONS", 24)
    one, other = room(1_500, 0), room(1_500, 1)
    fits = [align_clouds(one, other, generator=torch.Generator().manual_seed(3)).similarity.matrix() for _ in range(2)]
    assert torch.equal(fits[0], fits[1])


def test_a_symmetric_scene_is_refused(monkeypatch):
    monkeypatch.setattr(register, "ROTATIONS", 200)
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor([4.0, 3.0, 2.0])
    box = torch.rand(6_000, 3, generator=generator) * size
    side = torch.randint(6, (6_000,), generator=generator)
    for axis in range(3):
        box[side == 2 * axis, axis] = 0.0
        box[side == 2 * axis + 1, axis] = size[axis]
    with pytest.raises(SceneError, match=tells("clouds:", "got two", "symmetric", "cameras")):
        align_clouds(box[:3_000], a_similarity(2).apply(box[3_000:]))


def test_unrelated_clouds_are_refused(monkeypatch):
    monkeypatch.setattr(register, "ROTATIONS", 50)
    generator = torch.Generator().manual_seed(1)
    blob = torch.randn(5_000, 3, generator=generator) * torch.tensor([1.0, 2.0, 0.7])
    with pytest.raises(SceneError, match=tells("clouds:", "60%", "same scene")):
        align_clouds(room(4_000, 0), blob)


def test_clouds_without_a_shape_are_refused():
    # of 300 points 296 lie between the 1 % and the 99 % quantile
    line = torch.linspace(0, 1, 300)[:, None] * torch.tensor([1.0, 2.0, 3.0])
    with pytest.raises(SceneError, match=tells("dst:", "100", "got 296")):
        align_clouds(room(500, 0), line)
    with pytest.raises(SceneError, match=tells("src:", "100", "got 50")):
        align_clouds(room(50, 0), room(500, 0))
