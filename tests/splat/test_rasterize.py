from types import SimpleNamespace

import numpy as np
import oracles_splat as oracle
import pytest
import torch
from cases_splat import TOLERANCE, a_camera, gaussians_before
from messages import refused

from kfgs.cameras.camera import Camera
from kfgs.gaussians import Gaussians
from kfgs.splat import rasterize, rasterize_labels
from kfgs.splat.sh import SH_C0


@pytest.mark.parametrize("engine", ["reference", "auto"])
def test_antialiased_agrees_with_the_equations(engine):
    camera = a_camera()
    gaussians = gaussians_before(camera, 40, seed=1, spread=1.5)
    gaussians = gaussians.replace(scales=0.3 * gaussians.scales, antialiased=True)
    values = [v.numpy() for v in (gaussians.means, gaussians.quats, gaussians.scales)]
    pinhole = camera.viewmat.numpy(), camera.K.numpy(), camera.width, camera.height
    lowered = gaussians.opacities.numpy() * [oracle.compensation(*row, *pinhole) for row in zip(*values, strict=True)]
    maps, _ = oracle.render(*values, lowered, gaussians.features.numpy(), *pinhole)
    drawn = rasterize(gaussians, camera, engine=engine).map
    torch.testing.assert_close(drawn, torch.from_numpy(maps), rtol=0, atol=TOLERANCE[torch.float64])
    plain = rasterize(gaussians.replace(antialiased=False), camera, engine=engine).map
    assert (drawn - plain).abs().max() > 0.1
    labels = rasterize_labels(gaussians, camera, engine=engine)
    seen = labels.labels[..., 0] >= 0
    torch.testing.assert_close(labels.scores[seen][:, 0], torch.from_numpy(maps).amax(2)[seen], rtol=0, atol=1e-10)


def test_colour_is_seen_from_the_camera():
    # red grows towards -x: a Gaussian right of the camera is dark, seen from its own right side it is bright
    sh = torch.zeros(1, 4, 3)
    sh[0, 3, 0] = 0.8  # -C1 x
    ball = Gaussians(
        torch.tensor([[0.0, 0, 2]]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.4), torch.tensor([0.9]), sh=sh
    )
    K = torch.tensor([[10.0, 0, 8], [0, 10, 8], [0, 0, 1]])
    for shift, sign in ((-1.0, 1), (1.0, -1)):  # of the camera along x
        viewmat = torch.eye(4)
        viewmat[0, 3] = -shift
        rendering = rasterize(ball, Camera(viewmat, K, 16, 16))
        colour = rendering.map / rendering.alpha[..., None].clamp(min=1e-6)
        x = -shift / 5**0.5  # of the unit direction from the camera to the ball
        expected = torch.tensor([0.5 - 0.8 * 3**0.5 * SH_C0 * x, 0.5, 0.5])
        shown = colour[rendering.alpha > 0.1]
        torch.testing.assert_close(shown, expected.expand(len(shown), 3), rtol=1e-5, atol=0)
        assert (0.5 - expected[0]) * sign > 0


def test_features_are_rendered_before_colour():
    camera = a_camera()
    gaussians = gaussians_before(camera, 10, seed=9, channels=5)
    both = gaussians.replace(sh=torch.zeros(10, 1, 3).double())
    assert torch.equal(rasterize(both, camera).map, rasterize(gaussians, camera).map)


def test_gradient_of_the_projected_means_can_be_kept():
    camera = a_camera()
    gaussians = gaussians_before(camera, 20, seed=10)
    gaussians.means.requires_grad_()
    rendering = rasterize(gaussians, camera)
    rendering.projected.means2d.retain_grad()
    rendering.map.sum().backward()
    assert rendering.projected.means2d.grad.shape == (len(rendering.projected.index), 2)
    assert rendering.projected.means2d.grad.abs().max() > 0
    assert gaussians.means.grad.abs().max() > 0


@pytest.mark.parametrize("engine", ["auto", "reference"])
def test_gradients_from_the_map_to_the_gaussians(engine):
    camera = a_camera(8, 8, focal=(7.0, 8.0), principal=(3.7, 4.4))
    gaussians = gaussians_before(camera, 10, seed=11, spread=0.8, sigma=(0.1, 0.3), channels=2)
    assert len(rasterize(gaussians, camera).projected.index) == 10

    def render(means, quats, scales, opacities, features):
        return rasterize(Gaussians(means, quats, scales, opacities, features), camera, engine=engine)[:2]

    inputs = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.features)
    assert torch.autograd.gradcheck(render, [v.requires_grad_() for v in inputs], fast_mode=engine == "reference")


def test_gradients_of_colour_reach_harmonics_and_means():
    camera = a_camera(8, 8, focal=(7.0, 8.0), principal=(3.7, 4.4))
    gaussians = gaussians_before(camera, 5, seed=12, spread=0.8, sigma=(0.1, 0.3)).replace(features=None)
    sh = 0.1 * torch.randn(5, 9, 3, generator=torch.Generator().manual_seed(0)).double()

    def render(means, sh):
        return rasterize(gaussians.replace(means=means, sh=sh), camera).map

    inputs = gaussians.means.clone().requires_grad_(), sh.requires_grad_()
    assert torch.autograd.gradcheck(render, inputs, fast_mode=True)


@pytest.mark.parametrize("engine", ["reference", "auto"])
def test_depth_is_that_of_the_gaussian_where_half_of_the_opacity_is_reached(engine):
    camera = a_camera()
    gaussians = gaussians_before(camera, 20, seed=4, spread=1.5)  # fewer than layers: each is exact
    values = [v.numpy() for v in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)]
    weights, alpha = oracle.render(*values, np.eye(20), camera.viewmat.numpy(), camera.K.numpy(), 24, 18)
    z = (values[0] @ camera.viewmat.numpy()[:3, :3].T + camera.viewmat.numpy()[:3, 3])[:, 2]
    order = z.argsort()
    reached = weights[..., order].cumsum(axis=-1) >= alpha[..., None] / 2
    rendering = rasterize(gaussians, camera, engine=engine)
    expected = np.where(alpha > 0, z[order][reached.argmax(axis=-1)], 0)
    np.testing.assert_allclose(rendering.depth.numpy(), expected, rtol=1e-9)
    assert len(np.unique(expected)) > 8
    assert not rasterize(gaussians[:0], camera).depth.any()


def test_arguments_of_another_kind_and_mixed_types_are_named():
    camera = a_camera()
    gaussians = gaussians_before(camera, 4, seed=0)
    nothing = gaussians.replace(features=None)
    refused(lambda: rasterize(nothing, camera), "gaussians:", "got neither", "gaussians.replace()")
    held = SimpleNamespace(gaussians=gaussians)
    refused(lambda: rasterize(held, camera), "gaussians", "SimpleNamespace", ".gaussians", error=TypeError)
    refused(lambda: rasterize(gaussians, "view_0"), "camera", "str", "scene.cameras", error=TypeError)
    rendering = rasterize(gaussians.replace(features=gaussians.features.requires_grad_()), camera)
    assert torch.equal(torch.from_numpy(rendering.to_numpy()), rendering.map.detach())
    for name in ("quats", "scales", "opacities", "features"):
        mixed = gaussians.replace(**{name: getattr(gaussians, name).float()})
        words = f"gaussians.{name}", "float64", "torch.float32", "gaussians.to("
        refused(lambda mixed=mixed: rasterize(mixed, camera), *words)
