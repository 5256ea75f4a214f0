import pytest
import torch
from baselines import feature_3dgs
from baselines.trainer import Schedule, train
from small_task import MIB, cameras, cloud, rendered_maps, task


def test_loss_is_the_mean_over_pixels_and_channels():
    model = feature_3dgs.Features(3, 2, feature_3dgs.Feature3DGSConfig())
    rendered, target = torch.zeros(2, 2, 2), torch.zeros(2, 2, 2)
    target[0, 0] = torch.tensor([4.0, -2.0])
    assert float(model.loss(rendered, target, 1)) == pytest.approx(6 / 8)


def test_convolution_has_the_published_number_of_weights():
    model = feature_3dgs.Features(3, 512, feature_3dgs.Feature3DGSConfig.published(128))
    assert sum(value.numel() for value in model.convolution.parameters()) == 66_048
    assert float(model.convolution.weight.detach().abs().max()) <= 128**-0.5
    assert not model.own.any()


def test_storage_is_the_published_one():
    assert feature_3dgs.storage_bytes(602_200, 512, 512) / MIB == pytest.approx(1_175.2, rel=1e-3)
    assert feature_3dgs.storage_bytes(607_200, 128, 512) / MIB == pytest.approx(296.5, rel=1e-3)


def test_feature_loss_moves_no_geometry():
    geometry = cloud()
    shape = {
        name: getattr(geometry, name).clone().requires_grad_() for name in ("means", "quats", "scales", "opacities")
    }
    model = feature_3dgs.Features(len(geometry), 8, feature_3dgs.Feature3DGSConfig.published())
    options = {"generator": torch.Generator().manual_seed(0)}
    train(geometry.replace(**shape), cameras(), rendered_maps(), model, Schedule(3), **options)
    assert model.own.any()
    for name, value in shape.items():
        assert value.grad is None, name
        assert torch.equal(value.detach(), getattr(geometry, name)), name


@pytest.mark.parametrize("channels", [None, 4])
def test_fit_lowers_the_loss(channels):
    config = feature_3dgs.Feature3DGSConfig(channels, 120, 2e-2, 1e-2)
    found = feature_3dgs.fit(task(), config)
    assert found.history[-1]["loss"] < 0.75 * found.history[0]["loss"]
    assert found.storage == 4 * (12 * (channels or 8) + (0 if channels is None else 8 * channels + 8))
    assert found.dim == str(channels or 8)
