import pytest
import torch
from baselines.methods import LabelMaps, LinearDecoder, RenderedMethod
from small_task import cameras, cloud

from kfgs.evaluation import View
from kfgs.splat import rasterize


def method(matrix=None, bias=None, channels=3):
    features = torch.randn(12, channels, generator=torch.Generator().manual_seed(2))
    features[4] = 0
    one = cloud()
    one = one.replace(features=features, scales=0.4 * one.scales)  # so that some pixels stay empty
    return RenderedMethod("test", one, LinearDecoder(matrix, bias))


def text(channels):
    rows = torch.randn(4, channels, generator=torch.Generator().manual_seed(3))
    return rows / rows.norm(dim=1, keepdim=True)


@pytest.mark.parametrize(("matrix", "bias"), [(None, None), ("A", None), ("A", "b")])
def test_fast_labels_are_the_largest_cosines(matrix, bias):
    generator = torch.Generator().manual_seed(4)
    A = torch.randn(5, 3, generator=generator) if matrix else None
    b = torch.randn(5, generator=generator) if bias else None
    one, rows = method(A, b), text(5 if matrix else 3)
    for camera in cameras():
        cosines = one.cosines(View("view", camera), rows)[0]
        drawn = ~cosines[..., 0].isnan()
        labels = one.labels(View("view", camera), rows)
        assert torch.equal(labels >= 0, drawn)
        best = cosines.gather(2, labels.clamp_min(0)[..., None])[..., 0]
        assert torch.allclose(best[drawn], cosines.amax(2)[drawn], atol=1e-5)
        assert 0 < int(drawn.sum()) < drawn.numel()


def test_cosines_are_those_of_the_rendered_feature():
    one, rows, camera = method(), text(3), cameras()[0]
    map = rasterize(one.gaussians, camera).map[10, 12]
    found = one.cosines(View("view", camera), rows)
    assert found.shape == (1, 20, 24, 4)
    assert torch.allclose(found[0, 10, 12], rows @ map / map.norm(), atol=1e-5)


def test_votes_are_blended_softmaxes_of_what_each_gaussian_says():
    one, rows, camera = method(), text(3), cameras()[0]
    own = one.gaussian_cosines(rows)[0]
    votes = (100 * own).softmax(dim=1).nan_to_num()  # Gaussian 4 knows nothing
    blended = rasterize(one.gaussians.replace(features=votes), camera).map
    expected = blended.argmax(dim=2).masked_fill(blended.sum(dim=2) <= 0, -1)
    found = LabelMaps(one, rows, votes=True).labels(View("view", camera), rows)
    assert torch.equal(found, expected)
    assert not torch.equal(found, one.labels(View("view", camera), rows))  # the two rules differ
