"""The compiled SSIM: odd sizes, counted windows, borders of shares, and bits that do not depend on threads."""

import numpy as np
import pytest
import torch
from oracles_color import ssim_windows

pytest.importorskip("numba")

from kfgs.splat.engines.cpu.ssim import mean_ssim

CONSTANTS = 0.01**2, 0.03**2


def window(dtype):
    offsets = torch.arange(11, dtype=torch.float64) - 5
    weights = torch.exp(-(offsets**2) / (2 * 1.5**2))
    return (weights / weights.sum()).to(dtype)


def pictures(height, width, channels=3, dtype=torch.float64):
    g = torch.Generator().manual_seed(height * width)
    a = torch.rand(height, width, channels, generator=g, dtype=dtype)
    return a, 0.5 * a + 0.5 * torch.rand(height, width, channels, generator=g, dtype=dtype)


@pytest.mark.parametrize(
    ("height", "width", "channels"), [(11, 11, 3), (11, 30, 1), (45, 11, 2), (44, 19, 3), (76, 13, 4)]
)
def test_value_at_awkward_sizes(height, width, channels):
    a, b = pictures(height, width, channels)
    value, slope = mean_ssim(a, b, None, window(a.dtype), CONSTANTS)
    assert float(value) == pytest.approx(ssim_windows(a, b).mean(), abs=1e-12)
    assert slope.shape == a.shape
    for i, j in (
        (0, 0),
        (height - 1, width - 1),
        (height // 2, width // 2),
    ):  # central differences at corners and middle
        moved = [a.clone() for _ in range(2)]
        moved[0][i, j, 0] -= 1e-5
        moved[1][i, j, 0] += 1e-5
        low, high = (float(mean_ssim(x, b, None, window(a.dtype), CONSTANTS)[0]) for x in moved)
        assert float(slope[i, j, 0]) == pytest.approx((high - low) / 2e-5, rel=1e-4, abs=1e-9)


def test_only_counted_windows_count():
    a, b = pictures(40, 33)
    counted = torch.rand(30, 23, generator=torch.Generator().manual_seed(5)) < 0.3
    value, slope = mean_ssim(a, b, counted, window(a.dtype), CONSTANTS)
    assert float(value) == pytest.approx(ssim_windows(a, b)[counted.numpy()].mean(), abs=1e-12)
    one = torch.zeros_like(counted)
    one[4, 7] = True
    _, slope = mean_ssim(a, b, one, window(a.dtype), CONSTANTS)
    touched = (slope != 0).any(dim=2).nonzero()
    np.testing.assert_array_equal(touched.amin(dim=0), [4, 7])
    np.testing.assert_array_equal(touched.amax(dim=0), [14, 17])


def test_bits_do_not_depend_on_the_number_of_threads():
    a, b = pictures(200, 90, dtype=torch.float32)
    threads = torch.get_num_threads()
    try:
        found = []
        for count in (1, 2, 4):
            torch.set_num_threads(count)
            found.append(mean_ssim(a, b, None, window(a.dtype), CONSTANTS))
    finally:
        torch.set_num_threads(threads)
    for value, slope in found[1:]:
        assert torch.equal(value, found[0][0])
        assert torch.equal(slope, found[0][1])


def test_flat_pictures_are_finite():
    black = torch.zeros(20, 20, 3)
    value, slope = mean_ssim(black, black, None, window(black.dtype), CONSTANTS)
    assert float(value) == pytest.approx(1.0)
    assert not slope.any()
