import numpy as np
import oracles_splat as oracle
import pytest
import torch
from messages import refused
from scipy.spatial.transform import Rotation

from kfgs.splat.engines.table import load
from kfgs.splat.sh import SH_C0, evaluate_sh, rgb_to_sh0, rotate_sh, sh0_to_rgb


def _directions(N=50, seed=0):
    return torch.randn(N, 3, generator=torch.Generator().manual_seed(seed)).double()


def _response(coefficient, directions, K):
    """The harmonic that belongs to one coefficient: what a small amount of it adds to grey."""
    sh = torch.zeros(len(directions), K, 3, dtype=torch.float64)
    sh[:, coefficient, 1] = 0.1
    rgb = evaluate_sh(sh, directions)
    assert (rgb[:, [0, 2]] == 0.5).all()
    return (rgb[:, 1] - 0.5) / 0.1


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics_agree_with_legendre_functions(degree):
    directions = _directions()
    for order in range(-degree, degree + 1):
        expected = [oracle.real_harmonic(degree, order, d) for d in directions.numpy()]
        ours = _response(degree * (degree + 1) + order, directions, (degree + 1) ** 2)
        np.testing.assert_allclose(ours.numpy(), expected, atol=1e-13)


def test_negative_colour_is_clamped_and_has_no_gradient():
    sh = torch.tensor([[[-5.0, 0.0, 5.0]]], requires_grad=True)
    rgb = evaluate_sh(sh, torch.tensor([[0.0, 0.0, 1.0]]))
    torch.testing.assert_close(rgb, torch.tensor([[0.0, 0.5, 0.5 + 5 * SH_C0]]))  # bright is not clamped
    rgb.sum().backward()
    torch.testing.assert_close(sh.grad, torch.tensor([[[0.0, SH_C0, SH_C0]]]))


def test_rgb_survives_the_round_trip():
    rgb = torch.rand(7, 3, generator=torch.Generator().manual_seed(2))
    torch.testing.assert_close(sh0_to_rgb(rgb_to_sh0(rgb)), rgb)
    torch.testing.assert_close(evaluate_sh(rgb_to_sh0(rgb)[:, None], _directions(7).float()), rgb)


def test_number_of_coefficients_must_be_a_full_degree():
    refused(lambda: evaluate_sh(torch.zeros(2, 5, 3), torch.ones(2, 3)), "sh:", "expected 1, 4, 9 or 16", "got 5")


def test_one_direction_per_gaussian():
    refused(lambda: evaluate_sh(torch.zeros(2, 4, 3), torch.ones(1, 3)), "directions:", "[N, 3]", "N = 2", "got (1, 3)")


def _rotation(seed):
    return torch.from_numpy(Rotation.random(random_state=seed).as_matrix())


def _coefficients(K, seed=3):
    return 0.05 * torch.randn(50, K, 3, generator=torch.Generator().manual_seed(seed)).double()


@pytest.mark.parametrize("K", [1, 4, 9, 16])
@pytest.mark.parametrize("seed", range(3))
def test_turned_colours_seen_along_turned_directions_are_the_colours(K, seed):
    R, sh, d = _rotation(seed), _coefficients(K), _directions()
    turned = evaluate_sh(rotate_sh(sh, R), d @ R.T)
    torch.testing.assert_close(turned, evaluate_sh(sh, d), atol=1e-13, rtol=0)
    if K > 1:
        assert (evaluate_sh(rotate_sh(sh, R.T), d @ R.T) - turned).abs().max() > 1e-2  # the other way round is wrong


def test_turned_colours_keep_dtype_and_have_gradients():
    sh = _coefficients(9).float().requires_grad_()
    turned = rotate_sh(sh, _rotation(7))
    assert turned.dtype == torch.float32
    (turned**2).sum().backward()  # turning keeps the sum of squares
    torch.testing.assert_close(sh.grad, 2 * sh.detach(), atol=1e-6, rtol=1e-5)


def test_what_cannot_turn_colours_is_named():
    refused(lambda: rotate_sh(_coefficients(4), torch.diag(torch.tensor([1.0, 1.0, -1.0]))), "rotation:", "reflection")
    refused(lambda: rotate_sh(_coefficients(4), 2 * torch.eye(3)), "rotation:", "divide")
    refused(lambda: rotate_sh(torch.zeros(2, 5, 3), torch.eye(3)), "sh:", "expected 1, 4, 9 or 16", "got 5")


def _seen(K, dtype=torch.float64, N=20):
    generator = torch.Generator().manual_seed(K)
    sh, means = (torch.randn(*shape, generator=generator).to(dtype) for shape in ((N, K, 3), (N, 3)))
    return (2 * sh).requires_grad_(), means.requires_grad_(), torch.tensor([0.3, -0.2, 0.5], dtype=dtype)


@pytest.mark.parametrize("K", [1, 4, 9, 16])
def test_compiled_colours_and_gradients_are_those_of_evaluate_sh(K):
    sh, means, center = _seen(K)
    index = torch.tensor([0, 3, 4, 11, 19])
    expected = evaluate_sh(sh[index], means[index] - center)
    found = load("numba").shade(sh, means, center, index)
    assert bool((expected == 0).any()), "no channel is clamped"
    torch.testing.assert_close(found, expected)
    weights = torch.linspace(-1, 1, 15, dtype=torch.float64).view(5, 3)
    wanted = torch.autograd.grad((weights * expected).sum(), (sh, means), materialize_grads=True, allow_unused=True)
    got = torch.autograd.grad((weights * found).sum(), (sh, means))
    torch.testing.assert_close(got[0], wanted[0])
    torch.testing.assert_close(got[1], wanted[1])


def test_compiled_colours_in_single_precision_are_close_and_repeat():
    sh, means, center = _seen(16, torch.float32, 30_000)  # several bands
    index = torch.arange(0, 30_000, 2)
    found = load("numba").shade(sh, means, center, index)
    exact = evaluate_sh(sh[index].double(), (means[index] - center).double()).float()
    torch.testing.assert_close(found, exact, rtol=1e-5, atol=1e-5)
    assert torch.equal(found, load("numba").shade(sh, means, center, index))


def test_a_gaussian_at_the_camera_is_shaded():
    sh, means, _ = _seen(9)
    center = means[2].detach().clone()
    expected = evaluate_sh(sh[2:3], means[2:3] - center)
    found = load("numba").shade(sh, means, center, torch.tensor([2]))
    torch.testing.assert_close(found, expected)
    (got,) = torch.autograd.grad(found.sum(), means)
    (wanted,) = torch.autograd.grad(expected.sum(), means)
    torch.testing.assert_close(got, wanted)
