import numpy as np
import torch
from messages import refused

from kfgs.viz import FeatureColors


def cloud_of_features(seed=0, n=500, d=9):
    generator = torch.Generator().manual_seed(seed)
    scales = torch.tensor([5.0, 3.0, 2.0] + [0.1] * (d - 3))
    turn = torch.linalg.qr(torch.randn(d, d, generator=generator))[0]
    return (torch.randn(n, d, generator=generator) * scales) @ turn.T + 7, turn


def test_axes_are_the_principal_ones_and_the_same_in_every_view():
    features, turn = cloud_of_features()
    axes = FeatureColors.fit(features).axes
    assert torch.allclose((axes.float().T @ turn[:, :3]).abs(), torch.eye(3), atol=0.15)
    torch.testing.assert_close(axes.T @ axes, torch.eye(3, dtype=torch.float64))
    colors = FeatureColors.fit(features)  # equal features have equal colours in every view
    whole, part = colors(features.reshape(20, 25, 9)), colors(features[:40])
    assert (whole.shape, whole.dtype) == ((20, 25, 3), np.uint8)
    np.testing.assert_array_equal(whole.reshape(-1, 3)[:40], part)


def test_range_is_the_first_to_ninety_ninth_percentile():
    features, _ = cloud_of_features(n=2000)
    rgb = FeatureColors.fit(features)(features)
    for channel in range(3):
        assert 0.005 <= (rgb[:, channel] == 0).mean() <= 0.02
        assert 0.005 <= (rgb[:, channel] == 255).mean() <= 0.02


def test_missing_axes_stay_in_the_middle():
    rgb = FeatureColors.fit(torch.linspace(0, 1, 50)[:, None])(torch.linspace(0, 1, 50)[:, None])
    assert rgb[[0, -1], 0].tolist() == [0, 255]
    assert set(rgb[:, 1:].ravel().tolist()) == {128}
    constant = FeatureColors.fit(torch.ones(4, 5))(torch.ones(4, 5))
    assert set(constant.ravel().tolist()) == {128}


def test_wrong_features_are_named():
    colors = FeatureColors.fit(torch.randn(10, 4, generator=torch.Generator().manual_seed(0)))
    refused(lambda: colors(torch.ones(2, 2, 5)), "features:", "[..., D]", "D = 4", "got (2, 2, 5)")
    refused(lambda: FeatureColors.fit(torch.full((3, 2), torch.nan)), "features:", "got (3, 2)")
    refused(lambda: FeatureColors.fit(torch.empty(0, 3)), "features:", "got (0, 3)")


def test_what_learnt_nothing_has_no_say():
    features, _ = cloud_of_features()
    padded = torch.cat([features, torch.zeros(900, 9)])
    a, b = FeatureColors.fit(features), FeatureColors.fit(padded)
    torch.testing.assert_close(a.axes, b.axes)
    torch.testing.assert_close(a.low, b.low)
