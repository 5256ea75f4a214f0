from dataclasses import replace
from functools import partial

import numpy as np
import oracles_splat as oracle
import pytest
import torch
from cases_splat import a_camera, gaussians_before
from messages import refused, tells

from kfgs.cameras.camera import Camera, Distortion
from kfgs.gaussians import Gaussians
from kfgs.splat import available_engines
from kfgs.splat import project as project_by


@pytest.fixture(params=["reference", "numba"])
def project(request):
    """Kornia's functions, and what is compiled."""
    if request.param not in available_engines():
        pytest.skip(f"engine {request.param} is not installed")
    return partial(project_by, engine=request.param)


def _straight(width=20, height=10, focal=20.0, principal=(10.0, 5.0), dtype=torch.float64):
    """A camera at the origin that looks along z."""
    K = torch.tensor([[focal, 0, principal[0]], [0, focal, principal[1]], [0, 0, 1]], dtype=dtype)
    return Camera(torch.eye(4, dtype=dtype), K, width, height)


def _balls(means, scale=0.1, opacity=0.5, dtype=torch.float64):
    means = torch.as_tensor(means, dtype=dtype)
    N = len(means)
    quats = torch.tensor([[1.0, 0, 0, 0]], dtype=dtype).repeat(N, 1)
    return Gaussians(means, quats, torch.full((N, 3), scale, dtype=dtype), torch.full((N,), opacity, dtype=dtype))


def _oracle(gaussians, camera, **options):
    parts = zip(gaussians.means, gaussians.quats, gaussians.scales, strict=True)
    return [
        oracle.project(
            *(p.double().numpy() for p in part),
            camera.viewmat.numpy(),
            camera.K.numpy(),
            camera.width,
            camera.height,
            **options,
        )
        for part in parts
    ]


@pytest.mark.parametrize("spread", [1.0, 2.5])  # the second: many means lie outside the picture
def test_agrees_with_the_equations(project, spread):
    camera = a_camera()
    gaussians = gaussians_before(camera, 60, seed=1, spread=spread)
    projected = project(gaussians, camera)
    assert len(projected.index) > 20
    flat = [_oracle(gaussians, camera)[g] for g in projected.index]
    conics = [np.linalg.inv(cov)[[0, 0, 1], [0, 1, 1]] for _, cov, _ in flat]
    reach = [oracle.reach(o) for o in projected.opacities.numpy()]
    extents = [np.sqrt(r * cov.diagonal()) for r, (_, cov, _) in zip(reach, flat, strict=True)]
    np.testing.assert_allclose(projected.means2d.numpy(), [mean for mean, _, _ in flat], rtol=1e-11)
    np.testing.assert_allclose(projected.conics.numpy(), conics, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(projected.depths.numpy(), [z for _, _, z in flat], rtol=1e-12)
    np.testing.assert_allclose(projected.extents.numpy(), extents, rtol=1e-11)
    torch.testing.assert_close(projected.opacities, gaussians.opacities[projected.index], rtol=0, atol=0)


def test_ball_before_the_camera_by_hand(project):
    # focal 20, depth 2, scale 0.1: 1 pixel wide, variance 1 + 0.3
    projected = project(_balls([[0.2, 0.1, 2.0]]), _straight())
    torch.testing.assert_close(projected.means2d, torch.tensor([[12.0, 6.0]]).double())
    # the ball is seen aslant: J's last column adds (0.1, 0.05)^2 and their product
    cov = torch.tensor([[1 + 0.01 + 0.3, 0.005], [0.005, 1 + 0.0025 + 0.3]]).double()
    C = torch.linalg.inv(cov)
    torch.testing.assert_close(projected.conics, torch.stack([C[0, 0], C[0, 1], C[1, 1]])[None])


def test_low_pass_adds_to_the_variance(project):
    point = _balls([[0.0, 0.0, 2.0]], scale=1e-9)
    torch.testing.assert_close(project(point, _straight()).conics, torch.tensor([[1 / 0.3, 0, 1 / 0.3]]).double())
    wide = project(point, _straight(), low_pass=2.0)
    torch.testing.assert_close(wide.conics, torch.tensor([[0.5, 0, 0.5]]).double())


def test_antialiased_opacity_by_hand(project):
    # 0.1 pixels wide on the axis: det S = 0.01^2 of det (S + 0.3 I) = 0.31^2
    ball = _balls([[0.0, 0.0, 2.0]], scale=0.01).replace(antialiased=True)
    projected = project(ball, _straight())
    assert projected.opacities.item() == pytest.approx(0.5 * 0.01 / 0.31, rel=1e-12)
    reach = 2 * np.log(255 * 0.5 * 0.01 / 0.31)  # the fainter it is, the smaller is its box
    assert projected.extents[0].tolist() == pytest.approx([np.sqrt(0.31 * reach)] * 2)
    wide = _balls([[0.0, 0.0, 2.0]]).replace(antialiased=True)
    assert project(wide, _straight(), low_pass=0.0).opacities.item() == 0.5
    faint = project(ball.replace(scales=0.1 * ball.scales), _straight())
    assert len(faint.index) == 0  # 0.5 * 0.0001 / 0.3001 is below 1/255


def test_antialiased_gradients(project):
    camera = a_camera()
    cloud = gaussians_before(camera, 8, seed=8, spread=0.8).replace(antialiased=True, features=None)
    cloud = cloud.replace(scales=0.3 * cloud.scales)
    count = len(project(cloud, camera).index)
    assert count >= 4
    assert (project(cloud, camera).opacities < 0.8 * cloud.opacities[project(cloud, camera).index]).any()

    def flat(means, quats, scales, opacities):
        changed = cloud.replace(means=means, quats=quats, scales=scales, opacities=opacities)
        return project(changed, camera)[:4]

    inputs = [cloud.means, cloud.quats, cloud.scales, cloud.opacities]
    assert torch.autograd.gradcheck(flat, [v.requires_grad_() for v in inputs])


def test_antialiased_disc_seen_from_its_edge_has_no_gradient_that_is_nan(project):
    disc = _balls([[0.0, 0.0, 2.0]] * 2).replace(antialiased=True)
    disc.scales[0, 1] = 0.0  # one axis has no extent at all: det S = 0
    leaves = [v.requires_grad_() for v in (disc.means, disc.quats, disc.scales, disc.opacities)]
    projected = project(Gaussians(*leaves, antialiased=True), _straight())
    assert projected.index.tolist() == [1]
    sum((value**2).sum() for value in projected[:4]).backward()
    assert all(torch.isfinite(leaf.grad).all() for leaf in leaves)


def test_antialiased_needle_in_float32(project):
    # 100 pixels long, 0.01 thick, at 45 degrees
    quat = torch.tensor([[np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)]], dtype=torch.float32)
    scales = torch.tensor([[5.0, 5e-4, 5e-4]])
    needle = Gaussians(torch.tensor([[0.0, 0, 1]]), quat, scales, torch.tensor([0.9]), antialiased=True)
    camera = _straight(dtype=torch.float32)
    values = (v[0].double().numpy() for v in (needle.means, needle.quats, needle.scales))
    factor = oracle.compensation(*values, camera.viewmat.numpy(), camera.K.numpy(), 20, 10)
    assert 0.01 < factor < 0.02
    assert project(needle, camera).opacities.item() == pytest.approx(0.9 * factor, abs=1e-5)


@pytest.mark.parametrize(
    ("x", "tangent"),
    # borders at x/z = -0.2 and 0.8 (cx = 4): half the field is 0.5, so the limits are -0.2 - 0.15 and 0.8 + 0.15
    [(-0.3, -0.3), (-0.34, -0.34), (-0.6, -0.35), (0.9, 0.9), (0.94, 0.94), (1.2, 0.95)],
)
def test_jacobian_is_clamped_around_the_principal_point(project, x, tangent):
    camera = _straight(principal=(4.0, 5.0))
    projected = project(_balls([[2 * x, 0.0, 2.0]], scale=1.0), camera)
    u2 = 100 * (1 + tangent**2) + 0.3  # (focal scale / z)^2 (1 + tangent^2)
    torch.testing.assert_close(projected.conics, torch.tensor([[1 / u2, 0, 1 / 100.3]]).double())
    torch.testing.assert_close(projected.means2d[0, 0], torch.tensor(4.0 + 20 * x).double())  # the mean is not moved


def test_picture_that_does_not_hold_the_principal_point(project):
    # a crop far to the right of the axis: tangents from 5 to 6; a clamp at 1.3 times each border would cut it off
    camera = _straight(principal=(-100.0, 5.0))
    projected = project(_balls([[11.0, 0.0, 2.0]], scale=0.1), camera)
    torch.testing.assert_close(projected.means2d[0, 0], torch.tensor(10.0).double())
    torch.testing.assert_close(projected.conics[0, 0], torch.tensor(1 / (1 + 5.5**2 + 0.3)).double())


def test_culled_at_and_before_the_near_plane(project):
    depths = [-2.0, -0.2, 0.0, 0.2, 0.2000001, 0.3]
    projected = project(_balls([[0.0, 0.0, z] for z in depths], scale=0.01), _straight())
    assert projected.index.tolist() == [4, 5]
    assert project(_balls([[0.0, 0.0, 0.3]]), _straight(), near=0.5).index.tolist() == []
    assert project(_balls([[0.0, 0.0, 0.3]]), replace(_straight(), near=0.5)).index.tolist() == []
    assert project(_balls([[0.0, 0.0, 0.3]]), replace(_straight(), near=0.5), near=0.1).index.tolist() == [0]


def test_culled_where_too_transparent_to_show(project):
    on_a_centre = [0.05, 0.05, 2.0]
    opacities = torch.tensor([0.9 / 255, 1 / 255, 1.1 / 255], dtype=torch.float64)
    gaussians = _balls([on_a_centre] * 3).replace(opacities=opacities)
    assert project(gaussians, _straight()).index.tolist() == [2]


def test_culled_where_no_pixel_centre_is_touched(project):
    camera = a_camera()
    gaussians = gaussians_before(camera, 400, seed=4, spread=3.0, opacities=(0.004, 0.9))
    seen = set(project(gaussians, camera).index.tolist())
    x, y = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
    touched = set()
    for g, (mean, cov, _) in enumerate(_oracle(gaussians, camera)):
        C = np.linalg.inv(cov)
        dx, dy = x[None] - mean[0], y[:, None] - mean[1]
        density = np.exp(-0.5 * (C[0, 0] * dx**2 + 2 * C[0, 1] * dx * dy + C[1, 1] * dy**2))
        if (float(gaussians.opacities[g]) * density >= 1 / 255).any():
            touched.add(g)
    assert touched <= seen  # nothing that shows is lost
    assert len(touched) > 100
    assert len(seen - touched) < 0.1 * len(touched)  # boxes are a little larger than ellipses
    assert len(seen) < 300  # and something was culled


def test_needle_keeps_its_determinant_in_float32(project):
    # 2e5 pixels long, half a pixel thick, at 45 degrees: var_x var_y - cov^2 would round to noise
    quat = torch.tensor([[np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)]], dtype=torch.float32)
    gaussian = Gaussians(torch.tensor([[0.0, 0, 1]]), quat, torch.tensor([[1e4, 1e-6, 1e-6]]), torch.tensor([0.5]))
    camera = _straight(dtype=torch.float32)
    u, v = project(gaussian, camera).conics[0, [0, 2]].double()
    _, cov, _ = _oracle(gaussian, camera)[0]
    assert u.item() == pytest.approx(np.linalg.inv(cov)[0, 0], rel=1e-5)
    assert v.item() == pytest.approx(np.linalg.inv(cov)[1, 1], rel=1e-5)


def test_gaussians_that_are_not_finite_are_culled(project):
    broken = _balls([[float("nan"), 0, 2], [0, 0, 2], [float("inf"), 0, 2], [0, 0, float("inf")], [0, 0, 2]])
    broken.quats[1] = float("nan")
    broken.scales[1] = float("inf")
    assert project(broken, _straight()).index.tolist() == [4]


def test_gradients_of_gaussians_that_are_not_finite_are_zero(project):
    broken = _balls([[0, 0, 2.0]] * 5, dtype=torch.float32)
    broken.quats[0, 2] = float("nan")
    broken.quats[1, 0] = 1e30  # its square overflows
    broken.scales[2, 1] = 1e25
    broken.means[3, 1] = float("nan")
    leaves = [v.requires_grad_() for v in (broken.means, broken.quats, broken.scales, broken.opacities)]
    camera = _straight(dtype=torch.float32)
    pose = camera.viewmat.clone().requires_grad_()
    projected = project(Gaussians(*leaves), replace(camera, viewmat=pose))
    assert projected.index.tolist() == [4]
    sum((value**2).sum() for value in projected[:4]).backward()
    for leaf in leaves:
        assert torch.equal(leaf.grad[:4], torch.zeros_like(leaf[:4]))
        assert torch.isfinite(leaf.grad).all()
    assert leaves[2].grad[4].abs().max() > 0
    assert torch.isfinite(pose.grad).all()


def test_no_gaussians(project):
    projected = project(_balls(torch.zeros(0, 3)), _straight())
    assert [tuple(v.shape) for v in projected] == [(0, 2), (0, 3), (0,), (0,), (0, 2), (0,)]


def test_camera_pose_has_a_gradient(project):
    camera = a_camera()
    gaussians = gaussians_before(camera, 6, seed=8)
    viewmat = camera.viewmat.clone().requires_grad_()
    project(gaussians, replace(camera, viewmat=viewmat)).means2d.sum().backward()
    assert viewmat.grad[:3].abs().min() > 0


def test_camera_with_distortion_is_refused(project):
    camera = replace(a_camera(), distortion=Distortion("brown_conrady", (0.1, 0.0, 0.0, 0.0)))
    refused(lambda: project(_balls([[0.0, 0, 2]]), camera), "camera:", "got brown_conrady")


@pytest.mark.parametrize(
    ("options", "message"), [({"near": 0.0}, ("near:", "got 0.0")), ({"low_pass": -0.1}, ("low_pass:", "got -0.1"))]
)
def test_options_out_of_range(project, options, message):
    refused(lambda: project(_balls([[0.0, 0, 2]]), _straight(), **options), *message)


def test_compiled_engine_refuses_other_dtypes():
    half = _balls([[0.0, 0, 2]], dtype=torch.float16)
    with pytest.raises(ValueError, match=tells("engine:", "for torch.float16", "torch.float32 or torch.float64")):
        project_by(half, _straight(), engine="numba")


def test_other_dtypes_are_left_to_kornia():
    gaussians = _balls([[0.0, 0, 2]])
    mixed = gaussians.replace(opacities=gaussians.opacities.float())
    torch.testing.assert_close(project_by(mixed, _straight()).means2d, project_by(gaussians, _straight()).means2d)


def test_matrices_of_two_dtypes(project):
    camera, gaussians = a_camera(), gaussians_before(a_camera(), 10, seed=7)
    mixed = replace(camera, viewmat=camera.viewmat.float())
    torch.testing.assert_close(project(gaussians, mixed).means2d, project(gaussians, camera).means2d, rtol=0, atol=1e-4)
