"""The compiled losses: odd sizes, unknown pixels, borders of shares, and bits that do not depend on threads."""

import numpy as np
import pytest
import torch
from oracles_color import ssim_windows

pytest.importorskip("numba")

from kfgs.splat.engines.cpu.losses import absolute, similarity

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
    value, _, slope = similarity(a, b, None, window(a.dtype), CONSTANTS)
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
        low, high = (float(similarity(x, b, None, window(a.dtype), CONSTANTS)[0]) for x in moved)
        assert float(slope[i, j, 0]) == pytest.approx((high - low) / 2e-5, rel=1e-4, abs=1e-9)


def test_only_counted_windows_count():
    a, b = pictures(40, 33)
    counted = torch.rand(30, 23, generator=torch.Generator().manual_seed(5)) < 0.3
    value, _, slope = similarity(a, b, counted, window(a.dtype), CONSTANTS)
    assert float(value) == pytest.approx(ssim_windows(a, b)[counted.numpy()].mean(), abs=1e-12)
    one = torch.zeros_like(counted)
    one[4, 7] = True
    _, _, slope = similarity(a, b, one, window(a.dtype), CONSTANTS)
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
            found.append(similarity(a, b, None, window(a.dtype), CONSTANTS))
    finally:
        torch.set_num_threads(threads)
    for value, _, slope in found[1:]:
        assert torch.equal(value, found[0][0])
        assert torch.equal(slope, found[0][2])


def test_flat_pictures_are_finite():
    black = torch.zeros(20, 20, 3)
    value, _, slope = similarity(black, black, None, window(black.dtype), CONSTANTS)
    assert float(value) == pytest.approx(1.0)
    assert not slope.any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("unknown", [0.0, 0.01, 0.5, 1.0])
@pytest.mark.parametrize("size", [(1, 1, 1), (3, 5, 9), (130, 150, 3), (64, 40, 64)])
def test_absolute_difference_and_gradient(size, unknown, dtype):
    g = torch.Generator().manual_seed(size[0])
    a, b = (torch.randn(size, generator=g, dtype=dtype) for _ in range(2))
    a[::3] = b[::3]  # no difference: no slope
    b[torch.rand(size[:2], generator=g) < unknown, 0] = torch.nan
    leaf, known = a.clone().requires_grad_(), ~b.isnan().any(dim=2, keepdim=True)
    expected = torch.where(known, leaf - b, 0).abs().sum() / (known.sum() * size[2]).clamp_min(1)
    expected.backward()
    value, slope = absolute(a, b)
    rtol = 1e-5 if dtype == torch.float32 else 1e-12
    torch.testing.assert_close(value, expected.detach(), rtol=rtol, atol=0)
    torch.testing.assert_close(slope, leaf.grad, rtol=rtol, atol=0)
