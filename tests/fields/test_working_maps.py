import numpy as np
import pytest
import torch
from oracles_color import block_means

from kfgs import Camera, Gaussians, rasterize
from kfgs.fields.working_maps import WorkingMaps, shrink_camera, shrink_map


def test_blocks_are_averaged_and_the_rest_dropped():
    map = torch.rand(11, 14, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for divisor in (2, 3, 4):
        np.testing.assert_allclose(shrink_map(map, divisor).numpy(), block_means(map.numpy(), divisor), rtol=1e-12)


def test_a_block_with_an_unknown_pixel_is_unknown():
    map = torch.ones(4, 6, 3)
    map[1, 2] = torch.nan
    expected = torch.tensor([[False, True, False], [False, False, False]])
    assert torch.equal(shrink_map(map, 2)[..., 0].isnan(), expected)


def test_the_shrunken_camera_sees_the_shrunken_picture():
    """A world of wide Gaussians looks alike through both, though a row and a column are dropped."""
    K = torch.tensor([[60.0, 0, 33.1], [0, 62.0, 20.4], [0, 0, 1]], dtype=torch.float64)
    camera = Camera(torch.eye(4, dtype=torch.float64), K, 67, 43)
    g = torch.Generator().manual_seed(1)
    n = 12
    gaussians = Gaussians(
        means=torch.randn(n, 3, generator=g, dtype=torch.float64) * torch.tensor([1.0, 0.7, 0.3])
        + torch.tensor([0.0, 0.0, 4.0]),
        quats=torch.randn(n, 4, generator=g, dtype=torch.float64),
        scales=torch.full((n, 3), 0.6, dtype=torch.float64),
        opacities=torch.full((n,), 0.5, dtype=torch.float64),
        features=torch.rand(n, 3, generator=g, dtype=torch.float64),
    )
    small = shrink_camera(camera, 3)
    assert small.size == (14, 22)
    seen, expected = (
        rasterize(gaussians, small, engine="reference").map,
        shrink_map(rasterize(gaussians, camera, engine="reference").map, 3),
    )
    squeezed = rasterize(
        gaussians, camera.resized(14, 22), engine="reference"
    ).map  # the wrong reading: dropped pixels squeezed in
    assert (seen - expected).abs().mean() < 0.01
    assert (squeezed - expected).abs().mean() > 1.5 * (seen - expected).abs().mean()


@pytest.mark.parametrize(("height", "width"), [(107, 107), (90, 120), (48, 64)])
def test_the_working_camera_has_the_pixels_of_the_shrunken_map(height, width, tmp_path):
    """107 pixels are shrunk by 12 to 8 blocks, of which 11 pixels are left over: 107 // 8 is 13."""
    K = torch.tensor([[100.0, 0, width / 2], [0, 100.0, height / 2], [0, 0, 1]])
    camera = Camera(torch.eye(4), K, width, height)
    shrink = next(k for k in range(1, 200) if (height // k) * (width // k) <= 64)
    views = WorkingMaps([camera], [torch.rand(height, width, 3) + 0.1], torch.eye(3), 64, tmp_path)
    for view in (views[0], views[0]):  # made, and read from its file
        assert view.map.shape[:2] == (height // shrink, width // shrink)
        resized = torch.tensor([view.factor / shrink, view.factor / shrink, 1.0])
        torch.testing.assert_close(view.camera.K, K * resized[:, None])
        assert view.scale == pytest.approx((shrink / view.factor) ** 2)
