import math

import kornia.geometry
import numpy as np
import pytest
import torch
from messages import refused
from oracles_cameras import HEIGHT, LENSES, WIDTH, colmap_camera, colmap_pixels, pixel_rays

from kfgs.cameras import Camera, Distortion, undistort
from kfgs.cameras.projection import fold_radius, plane_to_pixel


def camera_of(model, dtype=torch.float64):
    K = torch.from_numpy(colmap_camera(model).calibration_matrix()).to(dtype)
    return Camera(torch.eye(4, dtype=dtype), K, WIDTH, HEIGHT, model, Distortion(*LENSES[model][1:]))


def coordinates(dtype=torch.float64):
    """A picture [H, W, 2] that holds each pixel centre's own (x, y): bilinear sampling of it returns the position."""
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    return torch.stack([x, y], -1).to(dtype)


def colmap_positions(model):
    """Where COLMAP says each undistorted pixel lies in the distorted picture, [H, W, 2]."""
    rays = pixel_rays(colmap_camera(model).calibration_matrix(), WIDTH, HEIGHT)
    return colmap_pixels(model, rays.reshape(-1, 3)).reshape(HEIGHT, WIDTH, 2)


def between_centers(positions):
    x, y = positions[..., 0], positions[..., 1]
    return (x >= 0.5) & (x <= WIDTH - 0.5) & (y >= 0.5) & (y <= HEIGHT - 0.5)


@pytest.mark.parametrize("model", LENSES)
def test_pixels_come_from_where_colmap_says(model):
    result, camera, mask = undistort(coordinates(), camera_of(model))
    expected = colmap_positions(model)
    inside = between_centers(expected)
    assert inside.mean() > 0.6
    assert mask.numpy()[inside].all()
    np.testing.assert_allclose(result.numpy()[inside], expected[inside], atol=1e-9)
    assert camera.distortion is None
    assert torch.equal(camera.K, camera_of(model).K)
    # leaving the picture as it is shows
    assert np.abs(coordinates().numpy() - expected)[inside].max() > 1


@pytest.mark.parametrize("model", LENSES)
def test_mask_is_the_area_of_the_distorted_picture(model):
    positions = colmap_positions(model)
    x, y = positions[..., 0], positions[..., 1]
    recorded = (x >= 0) & (x < WIDTH) & (y >= 0) & (y < HEIGHT)
    result, _, mask = undistort(torch.ones(HEIGHT, WIDTH, 1), camera_of(model))
    assert np.array_equal(mask.numpy(), recorded)
    torch.testing.assert_close(result[..., 0], mask.float())  # never darkened at the border


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "OPENCV", "FULL_OPENCV"])
def test_kornia_needs_the_shift_to_integer_centers(model):
    """kornia's own undistort_image equals ours with cx, cy - 0.5, and is visibly off with COLMAP's K."""
    camera, picture = camera_of(model), coordinates()
    coefficients = torch.tensor(camera.distortion.coefficients, dtype=torch.float64)
    ours, _, _ = undistort(picture, camera)
    inside = between_centers(colmap_positions(model))
    batch = picture.permute(2, 0, 1)[None]
    shifted, unshifted = camera.K.clone(), camera.K
    shifted[:2, 2] -= 0.5
    right, wrong = (
        kornia.geometry.calibration.undistort_image(batch, K[None], coefficients[None])[0].permute(1, 2, 0)
        for K in (shifted, unshifted)
    )
    assert (right - ours)[inside].abs().max() < 1e-9
    assert (wrong - ours)[inside].abs().max() > 0.05


def test_pinhole_returns_what_came():
    camera = Camera(torch.eye(4), camera_of("OPENCV").K.float(), WIDTH, HEIGHT)
    picture = coordinates(torch.float32)
    result, same, mask = undistort(picture, camera)
    assert torch.equal(result, picture)
    assert same is camera
    assert mask.all()


def test_smaller_feature_map_with_the_resized_camera():
    """The lens knows nothing of pixels: positions found at half the size are half the positions."""
    camera = camera_of("OPENCV").resized(HEIGHT // 2, WIDTH // 2)
    y, x = torch.meshgrid(torch.arange(HEIGHT // 2) + 0.5, torch.arange(WIDTH // 2) + 0.5, indexing="ij")
    result, _, mask = undistort(torch.stack([x, y], -1).double(), camera)
    rays = pixel_rays(camera.K.numpy(), WIDTH // 2, HEIGHT // 2)
    expected = colmap_pixels("OPENCV", rays.reshape(-1, 3)).reshape(HEIGHT // 2, WIDTH // 2, 2) / 2
    interior = mask.numpy().copy()
    interior[[0, -1]] = interior[:, [0, -1]] = False
    np.testing.assert_allclose(result.numpy()[interior], expected[interior], atol=1e-9)


def test_folded_rays_count_as_unrecorded():
    lens = Distortion("brown_conrady", (-1 / 3, 0.0, 0.0, 0.0))  # turns back at r = 1
    K = torch.tensor([[20.0, 0, 48], [0, 20, 32], [0, 0, 1]])  # the picture reaches out to r = 2.9
    _, _, mask = undistort(torch.ones(HEIGHT, WIDTH, 1), Camera(torch.eye(4), K, WIDTH, HEIGHT, "", lens))
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    radius = ((x - 48) ** 2 + (y - 32) ** 2).sqrt() / 20
    assert torch.equal(mask, radius < 1)


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
def test_labels_come_from_the_nearest_pixel(model):
    labels = torch.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH, 1)
    result, _, mask = undistort(labels.double(), camera_of(model), mode="nearest")
    positions = colmap_positions(model)
    expected = np.floor(positions[..., 1]) * WIDTH + np.floor(positions[..., 0])
    assert np.array_equal(result[mask][:, 0].numpy(), expected[mask.numpy()])


def test_undistort_refusals():
    camera = camera_of("OPENCV")
    refused(lambda: undistort(torch.zeros(WIDTH, HEIGHT, 3), camera), "image:", "[64, 96, C]", "got (96, 64, 3)")
    refused(lambda: undistort(coordinates().byte(), camera), "image:", "got torch.uint8", ".float()", error=TypeError)


K = torch.tensor([[70.0, 0.0, 50.0], [0.0, 66.0, 30.5], [0.0, 0.0, 1.0]], dtype=torch.float64)


@pytest.mark.parametrize("i", range(4))
def test_each_fisheye_coefficient_in_closed_form(i):
    # theta + k theta^n has slope 1 + n k theta^(n - 1), which vanishes at theta = 1 for k = -1 / n, n = 3, 5, 7, 9
    coefficients = [0.0] * 4
    coefficients[i] = -1 / (2 * i + 3)
    assert fold_radius(Distortion("kannala_brandt", tuple(coefficients))) == pytest.approx(math.tan(1))
    # theta - theta^3 / 12 turns at 2 radians, which no ray in front of the camera reaches
    assert fold_radius(Distortion("kannala_brandt", (-1 / 12, 0, 0, 0))) == math.inf


@pytest.mark.parametrize(("i", "value"), [(0, -1 / 3), (1, -1 / 5), (4, -1 / 7), (5, 1.0), (6, 1 / 3), (7, 1 / 5)])
def test_each_radial_coefficient_in_closed_form(i, value):
    # r + k r^n as above; r / (1 + k r^n) has slope zero where 1 + (1 - n) k r^n = 0, at r = 1 for k = 1 / (n - 1)
    coefficients = [0.0] * 8
    coefficients[i] = value
    assert fold_radius(Distortion("brown_conrady", tuple(coefficients))) == pytest.approx(1)
    tangential = tuple(0.01 if j in (2, 3) else k for j, k in enumerate(coefficients))
    assert fold_radius(Distortion("brown_conrady", tangential)) == pytest.approx(1)  # p1, p2 are left out


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
