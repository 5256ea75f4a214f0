import pytest
import torch
from baselines import occam
from small_task import cameras, cloud, task

from kfgs.cameras import Camera, resize_map
from kfgs.gaussians import Gaussians
from kfgs.splat import rasterize

CAMERA = Camera(torch.eye(4), torch.tensor([[10.0, 0, 0], [0, 10, 0], [0, 0, 1]]), 20, 20)


def balls(*rows):
    """Gaussians with their centres at pixel places (x, y), at some depths, with opacities; all small and round."""
    x, y, depth, opacity = torch.tensor(rows).T
    return Gaussians(
        means=torch.stack([x * depth / 10, y * depth / 10, depth], dim=1),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(len(rows), 1),
        scales=1e-4 * depth[:, None].repeat(1, 3),
        opacities=opacity,
    )


def test_weight_is_alpha_at_the_pixel_below_the_centre():
    # variance 0.3 pixels^2 (low pass); mean (8.7, 5.2): pixel floor(m - 0.5) = (8, 4), its centre (8.5, 4.5)
    index, weight, pixel = occam.centre_weights(balls((8.7, 5.2, 2.0, 0.6)), CAMERA)
    assert index.tolist() == [0]
    assert pixel.tolist() == [[5, 8]]  # (row, column) of floor(m): a row below the weight's
    assert float(weight) == pytest.approx(0.6 * 2.718281828 ** (-0.5 * (0.2**2 + 0.7**2) / 0.3), rel=1e-3)


def test_weights_are_those_of_the_renderer():
    geometry = cloud(60)
    one_hot = geometry.replace(features=torch.eye(60))
    for camera in cameras():
        rendered = rasterize(one_hot, camera)
        index, weight, _ = occam.centre_weights(geometry, camera)
        found = dict(zip(index.tolist(), weight.tolist(), strict=True))
        for row, mean in zip(rendered.projected.index.tolist(), rendered.projected.means2d, strict=True):
            x, y = (mean - 0.5).floor().long().tolist()
            if 0 <= x < 24 and 0 <= y < 20:
                assert found.get(row, 0.0) == pytest.approx(float(rendered.map[y, x, row]), abs=1e-5)


def test_average_is_that_of_unit_features_at_the_centres():
    one = task()
    found, weights = occam.centre_average(one.geometry, one.cameras, one.maps)
    sums, total = torch.zeros(12, 8), torch.zeros(12)
    for camera, map in zip(one.cameras, one.maps, strict=True):
        large = resize_map(map, camera.size)
        for i, weight, (row, column) in zip(*occam.centre_weights(one.geometry, camera), strict=True):
            sums[i] += weight * large[row, column] / large[row, column].norm()
            total[i] += weight
    assert torch.allclose(weights, total, atol=1e-5)
    assert torch.allclose(found[total > 0], (sums / total[:, None])[total > 0], atol=1e-5)
    assert not found[total == 0].any()


def test_average_and_pruning():
    found = occam.fit(task(), occam.OccamConfig.published())
    kept = found.tensors["kept"]
    assert len(found.method.gaussians) == int(kept.sum()) == found.storage // (4 * 8)
    lengths = found.tensors["features"].norm(dim=1)
    assert float(lengths.max()) <= 1 + 1e-5  # a mean of unit rows
