"""The oracle of a click: against renderings, and by hand."""

from dataclasses import replace

import pytest
import torch
from cases_explorer import cloud
from cases_viz import some_camera, some_gaussians
from messages import refused, tells
from oracles_picking import gaussian_at

from kfgs.cameras import Camera, Distortion
from kfgs.splat import rasterize


def straight(shift=0.0, name="front"):
    """Looks along z with the axis at pixel (20.5, 10.5)."""
    viewmat = torch.eye(4)
    viewmat[0, 3] = shift
    return Camera(viewmat, torch.tensor([[50.0, 0, 20.5], [0, 50, 10.5], [0, 0, 1]]), 40, 20, name)


def row(depths, opacities, scale=0.05):
    """Balls on the axis: at pixel (20.5, 10.5) each one's density is 1."""
    n = len(depths)
    return cloud([[0, 0, z] for z in depths]).replace(
        opacities=torch.tensor(opacities), scales=torch.full((n, 3), scale)
    )


@pytest.mark.parametrize(
    ("opacities", "expected"),
    [
        ([0.4, 0.9], 1),  # 0.4 and 0.6 x 0.9 = 0.54
        ([0.5, 0.9], 0),  # 0.5 and 0.5 x 0.9 = 0.45
        ([0.9, 0.9], 0),
        ([0.03, 0.6], 1),
        ([1.0, 1.0], 0),  # alphas are at most 0.99
        ([0.04, 0.0], 0 - 1),  # together less than 5 %: background
        ([0.06, 0.0], 0),
    ],
)
def test_of_two_behind_each_other_the_larger_weight_wins(opacities, expected):
    for order in ([0, 1], [1, 0]):  # whichever comes first in the cloud
        made = row([3.0, 5.0], opacities).select(torch.tensor(order))
        found = gaussian_at(made, straight(), 20.5, 10.5)
        assert found == (None if expected < 0 else order.index(expected))


def test_background_outside_and_behind_the_camera():
    made = row([3.0, -3.0], [0.5, 0.99])
    assert gaussian_at(made, straight(), 20.5, 10.5) == 0
    assert gaussian_at(made, straight(), 38.5, 2.5) is None  # nothing there
    assert gaussian_at(made.select(torch.tensor([1])), straight(), 20.5, 10.5) is None  # behind
    assert gaussian_at(row([0.1], [0.99]), straight(), 20.5, 10.5) is None  # nearer than camera.near
    for x, y in ((-0.1, 10.5), (40.0, 10.5), (20.5, -1), (20.5, 20)):
        assert gaussian_at(row([3.0], [0.99], scale=9.0), straight(), x, y) is None


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("opaque", [False, True])
def test_agrees_with_a_rendering_that_names_each_gaussian(seed, opaque):
    """One-hot features: channel i of the picture is the weight of Gaussian i."""
    made = some_gaussians(60, seed).to(torch.float64)
    if opaque:  # pixels stop early
        made = made.replace(opacities=0.9 + 0.1 * made.opacities)
    camera = some_camera(24, 32)
    camera = replace(camera, K=camera.K * torch.tensor([[0.2], [0.2], [1.0]], dtype=torch.float64))
    mask = torch.rand(60, generator=torch.Generator().manual_seed(seed)) < 0.7
    for drawn in (torch.ones(60, dtype=torch.bool), mask):
        index = drawn.nonzero()[:, 0]
        one_hot = torch.eye(60, dtype=torch.float64)[index]
        picture = rasterize(made.select(index).replace(features=one_hot, sh=None), camera, engine="reference").map
        winner = picture.argmax(dim=-1)
        expected = torch.where(picture.sum(dim=-1) < 0.05, -1, winner)
        found = [[gaussian_at(made, camera, x + 0.5, y + 0.5, drawn) for x in range(1, 32, 3)] for y in range(0, 24, 2)]
        got = torch.tensor([[-1 if one is None else one for one in line] for line in found])
        assert torch.equal(got, expected[::2, 1::3])
        assert len(got.unique()) > 10
        assert -1 in got


def test_wrong_arguments():
    made = row([3.0], [0.5])
    with pytest.raises(ValueError, match=tells("mask:", "[N]", "N = 1", "gaussians.means", "got (2,)")):
        gaussian_at(made, straight(), 1.0, 1.0, torch.ones(2, dtype=torch.bool))
    bent = replace(straight(), distortion=Distortion("kannala_brandt", (0.1, 0, 0, 0)))
    refused(lambda: gaussian_at(made, bent, 1.0, 1.0), "camera:", "got kannala_brandt")
