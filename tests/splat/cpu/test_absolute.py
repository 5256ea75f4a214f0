"""The compiled absolute difference: odd sizes, unknown pixels, and bits that do not depend on threads."""

import pytest
import torch

pytest.importorskip("numba")

from kfgs.splat.engines.cpu.absolute import absolute


def maps(height, width, channels, dtype):
    g = torch.Generator().manual_seed(height * width + channels)
    a, b = (torch.randn(height, width, channels, generator=g, dtype=dtype) for _ in range(2))
    a[::3] = b[::3]  # no difference: no slope
    return a, b


def by_torch(a, b):
    a = a.clone().requires_grad_()
    known = ~b.isnan().any(dim=2, keepdim=True)
    value = torch.where(known, a - b, 0).abs().sum() / (known.sum() * b.shape[2]).clamp_min(1)
    value.backward()
    return value.detach(), a.grad


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [(1, 1, 1), (3, 5, 9), (7, 40, 3), (130, 150, 2), (64, 40, 64)])
def test_value_and_gradient(size, dtype):
    a, b = maps(*size, dtype)
    found, expected = absolute(a, b), by_torch(a, b)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5 if dtype == torch.float32 else 1e-12, atol=0)


@pytest.mark.parametrize("share", [0.01, 0.5, 1.0])
def test_unknown_pixels_do_not_count(share):
    a, b = maps(130, 150, 3, torch.float64)
    g = torch.Generator().manual_seed(1)
    b[torch.rand(130, 150, generator=g) < share, 1] = torch.nan
    found, expected = absolute(a, b), by_torch(a, b)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other)


def test_bits_do_not_depend_on_the_number_of_threads():
    a, b = maps(200, 170, 3, torch.float32)
    b[150:, 20] = torch.nan
    threads, found = torch.get_num_threads(), []
    try:
        for count in (1, 2, 4):
            torch.set_num_threads(count)
            found.append(absolute(a, b))
    finally:
        torch.set_num_threads(threads)
    for value, slope in found[1:]:
        assert value.equal(found[0][0])
        assert slope.equal(found[0][1])
