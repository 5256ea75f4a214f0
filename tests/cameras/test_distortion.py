import math

import numpy as np
import pytest
import torch
from oracles_cameras import LENSES

from kfgs.cameras import Distortion
from kfgs.cameras.projection import fold_radius, plane_to_pixel

K = torch.tensor([[70.0, 0.0, 50.0], [0.0, 66.0, 30.5], [0.0, 0.0, 1.0]], dtype=torch.float64)


@pytest.mark.parametrize("i", range(4))
def test_each_fisheye_coefficient_in_closed_form(i):
    # theta + k theta^n has slope 1 + n k theta^(n - 1), which vanishes at theta = 1 for k = -1 / n, n = 3, 5, 7, 9
    coefficients = [0.0] * 4
    coefficients[i] = -1 / (2 * i + 3)
    assert fold_radius(Distortion("kannala_brandt", tuple(coefficients))) == pytest.approx(math.tan(1))


@pytest.mark.parametrize(("i", "value"), [(0, -1 / 3), (1, -1 / 5), (4, -1 / 7), (5, 1.0), (6, 1 / 3), (7, 1 / 5)])
def test_each_radial_coefficient_in_closed_form(i, value):
    # r + k r^n as above; r / (1 + k r^n) has slope zero where 1 + (1 - n) k r^n = 0, at r = 1 for k = 1 / (n - 1)
    coefficients = [0.0] * 8
    coefficients[i] = value
    assert fold_radius(Distortion("brown_conrady", tuple(coefficients))) == pytest.approx(1)
    tangential = tuple(0.01 if j in (2, 3) else k for j, k in enumerate(coefficients))
    assert fold_radius(Distortion("brown_conrady", tangential)) == pytest.approx(1)  # p1, p2 are left out


def test_fisheye_fold_in_closed_form():
    # theta - theta^3 turns at theta = 1 / sqrt(3)
    assert fold_radius(Distortion("kannala_brandt", (-1.0, 0, 0, 0))) == pytest.approx(math.tan(1 / math.sqrt(3)))
    # theta - theta^3 / 12 turns at 2 radians, which no ray in front of the camera reaches
    assert fold_radius(Distortion("kannala_brandt", (-1 / 12, 0, 0, 0))) == math.inf


@pytest.mark.parametrize(
    "lens",
    [Distortion(kind, coefficients) for _, kind, coefficients in LENSES.values()]
    + [Distortion("brown_conrady", (-0.3, 0.08, 0.0, 0.0)), Distortion("kannala_brandt", (-0.3, 0.01, 0.0, 0.0))],
    ids=str,
)
def test_fold_is_where_the_radius_stops_growing(lens):
    """Against the largest radius up to which a dense sampling of the radial map grows."""
    if lens.model == "brown_conrady":
        lens = Distortion(lens.model, (*lens.coefficients[:2], 0.0, 0.0, *lens.coefficients[4:]))
    r = np.linspace(1e-4, 6, 60001)
    plane = torch.from_numpy(np.stack([r, np.zeros_like(r)], 1))
    mapped = plane_to_pixel(plane, torch.eye(3, dtype=torch.float64), lens)[:, 0].numpy()
    falls = np.flatnonzero(np.diff(mapped) < 0)
    expected = r[falls[0]] if len(falls) else math.inf
    found = fold_radius(lens)
    if found > r[-1]:
        assert expected == math.inf
    else:
        assert found == pytest.approx(expected, abs=3e-4)


def test_slopes_are_clamped_only_with_a_lens():
    far = torch.tensor([[1e12, 0.0]])
    lens = Distortion("brown_conrady", (0.0, 0.0, 0.0, 0.0, 1.0))
    assert torch.isfinite(plane_to_pixel(far, K.float(), lens)).all()
    assert plane_to_pixel(far.double(), K)[0, 0] == pytest.approx(70e12)
