import pytest
import torch
from baselines import occam
from small_task import cameras, cloud, task

from kfgs.cameras import resize_map
from kfgs.splat import rasterize


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
