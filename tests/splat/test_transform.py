from dataclasses import replace

import pytest
import torch
from scipy.spatial.transform import Rotation

from kfgs.cameras import Camera, Similarity
from kfgs.gaussians import Gaussians
from kfgs.splat import rasterize, transform_gaussians


def a_similarity(seed=0):
    R = torch.from_numpy(Rotation.random(random_state=seed).as_matrix())
    return Similarity(1.7 + seed, R, torch.tensor([3.0, -1.0, 2.0]) * (1 + seed))


def a_cloud(N=60, dtype=torch.float64):
    g = torch.Generator().manual_seed(0)
    rand = lambda *shape: torch.rand(*shape, generator=g, dtype=torch.float64)  # noqa: E731
    return Gaussians(
        means=rand(N, 3) * torch.tensor([2.0, 1.5, 3.0]) + torch.tensor([-1.0, -0.7, 2.0]),
        quats=rand(N, 4) * 4 - 2,  # not unit
        scales=0.03 + 0.2 * rand(N, 3),
        opacities=0.2 + 0.7 * rand(N),
        sh=rand(N, 16, 3) - 0.5,
        labels=torch.arange(N) % 5 - 1,
    ).to(dtype)


def a_camera():
    K = torch.tensor([[30.0, 0, 17], [0, 26, 11], [0, 0, 1]]).double()
    return Camera(torch.eye(4).double(), K, 32, 24)


@pytest.mark.parametrize("seed", range(3))
def test_moved_scene_from_moved_camera_is_the_same_picture(seed):
    cloud, camera, similarity = a_cloud(), a_camera(), a_similarity(seed)
    before = rasterize(cloud, camera, engine="reference")
    moved = transform_gaussians(cloud, similarity)
    after = rasterize(moved, similarity.apply_to_camera(camera), engine="reference")
    torch.testing.assert_close(after.map, before.map, atol=1e-9, rtol=0)
    torch.testing.assert_close(after.alpha, before.alpha, atol=1e-9, rtol=0)
    assert before.alpha.mean() > 0.3
    assert before.map.std() > 0.1
    stale = moved.replace(sh=cloud.sh)  # colours that did not turn are another picture
    assert (rasterize(stale, similarity.apply_to_camera(camera)).map - before.map).abs().max() > 0.05


@pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
def test_the_near_plane_cuts_the_same_gaussians_at_every_scale(scale):
    cloud, camera = a_cloud(), replace(a_camera(), near=3.0)  # in the middle of the cloud
    similarity = replace(a_similarity(), scale=scale)
    moved = transform_gaussians(cloud, similarity)
    before = rasterize(cloud, camera, engine="reference")
    after = rasterize(moved, similarity.apply_to_camera(camera), engine="reference")
    assert 0 < len(before.projected.index) < len(rasterize(cloud, a_camera()).projected.index)
    assert after.projected.index.equal(before.projected.index)
    torch.testing.assert_close(after.map, before.map, atol=1e-9, rtol=0)


def test_quarter_turn_in_closed_form():
    half = 0.5**0.5
    quarter = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    one = Gaussians(torch.tensor([[1.0, 0, 0]]), torch.tensor([[1.0, 0, 0, 0]]), torch.ones(1, 3), torch.ones(1))
    moved = transform_gaussians(one, Similarity(2.0, quarter, torch.zeros(3)))
    torch.testing.assert_close(moved.quats, torch.tensor([[half, 0, 0, half]]))
    assert moved.means.tolist() == [[0, 2, 0]]
    assert moved.scales.tolist() == [[2, 2, 2]]
    assert moved.sh is None
