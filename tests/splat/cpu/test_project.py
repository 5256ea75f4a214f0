"""The compiled projection against kornia's functions under autograd, where Gaussians are awkward."""

import platform
import re

import numpy as np
import pytest
import torch
from cases_splat import a_camera, gaussians_before

from kfgs.cameras.camera import Camera
from kfgs.gaussians import Gaussians
from kfgs.splat import project

numba = pytest.importorskip("numba")

from kfgs.splat.engines.contract import Pinhole  # noqa: E402
from kfgs.splat.engines.cpu import project as numba_project  # noqa: E402
from kfgs.splat.engines.cpu import project_backward as numba_project_backward  # noqa: E402
from kfgs.splat.engines.cpu import project_forward as numba_project_forward  # noqa: E402

SCENES = 300
DTYPES = [torch.float32, torch.float64]


def _camera(seed, dtype=torch.float64):
    """Any camera: the principal point may lie far beside the picture."""
    g = np.random.default_rng(seed)
    width, height = int(g.integers(1, 60)), int(g.integers(1, 60))
    focal = tuple(g.uniform(5, 80, 2))
    beside = g.uniform(-3, 4, 2) if seed % 3 == 0 else g.uniform(0.3, 0.7, 2)
    principal = (width * beside[0], height * beside[1])
    return a_camera(width, height, focal=focal, principal=principal, seed=seed, dtype=dtype)


def _awkward(camera, seed, N=48):
    """Gaussians in and around the view of which every other one is degenerate in some way."""
    g = np.random.default_rng(seed)
    gaussians = gaussians_before(camera, N, seed=seed, spread=float(g.choice([0.8, 2.0, 6.0])), depth=(0.21, 10.0))
    means, quats, scales, opacities = (
        v.clone() for v in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)
    )
    forward, eye = camera.viewmat[2, :3], camera.center
    for i in range(0, N, 2):
        kind = int(g.integers(14))
        if kind == 0:  # needle
            scales[i] *= torch.tensor([10 ** g.uniform(0, 2.5), 1e-3, 1e-3], dtype=scales.dtype)
        elif kind == 1:  # flat disc
            scales[i, int(g.integers(3))] *= 1e-6
        elif kind == 2:  # huge
            scales[i] *= 10 ** g.uniform(1, 3)
        elif kind == 3:  # far below a pixel
            scales[i] *= 1e-7
        elif kind == 4:  # behind the camera
            means[i] = 2 * eye - means[i]
        elif kind == 5:  # next to the near plane
            means[i] += forward * (0.2 + float(g.choice([-1e-9, 1e-9, 1e-3])) - forward @ (means[i] - eye))
        elif kind == 6:  # far beside the picture, and large
            means[i] += camera.viewmat[int(g.integers(2)), :3] * float(g.choice([-1, 1])) * 10 ** g.uniform(0, 1.5)
            scales[i] *= 10 ** g.uniform(0, 2)
        elif kind == 7:  # not of unit norm, or below the norm's floor, or no rotation at all
            quats[i] *= float(g.choice([1e-3, 1e5, 1e-11, 1e-13, 0.0]))
        elif kind == 8:  # just visible, or just not
            opacities[i] = (1 + float(g.choice([-1e-6, 0, 1e-6, 1e-3]))) / 255
        elif kind == 9:
            opacities[i] = float(g.choice([0.0, 1.0, 0.999999]))
        elif kind == 10:
            [means, quats, scales][int(g.integers(3))][i, int(g.integers(3))] = float(g.choice([np.nan, np.inf]))
        elif kind == 11:
            opacities[i] = float(g.choice([np.nan, np.inf, -1.0]))
        elif kind == 12:  # overflows on the way
            [means, quats, scales][int(g.integers(3))][i] *= 1e200
    return Gaussians(means, quats, scales, opacities)


def _leaves(gaussians):
    values = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities
    return [v.detach().clone().requires_grad_() for v in values]


def _run(gaussians, camera, engine, seed=0):
    """What is projected, and the gradients of a random sum of it."""
    leaves = _leaves(gaussians)
    projected = project(Gaussians(*leaves), camera, engine=engine)
    g = torch.Generator().manual_seed(seed)
    cotangents = [torch.randn(v.shape, generator=g, dtype=torch.float64).to(v.dtype) for v in projected[:4]]
    return projected, torch.autograd.grad(projected[:4], leaves, cotangents)


def _row_error(actual, expected):
    """Largest error of a row, relative to the row's own size."""
    actual, expected = actual.reshape(len(actual), -1), expected.reshape(len(expected), -1)
    size = expected.norm(dim=1)
    error = (actual - expected).norm(dim=1)
    assert torch.isfinite(actual).all()
    return float((error / size.clamp(min=1e-300)).nan_to_num().max()) if len(actual) else 0.0


def test_agrees_with_kornia_and_autograd_in_any_scene():
    seen, culled, worst = 0, 0, np.zeros(9)
    for seed in range(SCENES):
        camera = _camera(seed)
        gaussians = _awkward(camera, seed)
        expected, expected_grads = _run(gaussians, camera, "reference", seed)
        actual, actual_grads = _run(gaussians, camera, "numba", seed)
        assert torch.equal(actual.index, expected.index), f"scene {seed}"
        assert torch.equal(actual.opacities, expected.opacities)
        seen, culled = seen + len(actual.index), culled + 48 - len(actual.index)
        errors = [_row_error(a.detach(), e.detach()) for a, e in zip(actual[:5], expected[:5], strict=True)]
        errors += [_row_error(a, e) for a, e in zip(actual_grads, expected_grads, strict=True)]
        worst = np.maximum(worst, errors)
        hidden = torch.ones(48, dtype=torch.bool)
        hidden[actual.index] = False
        assert all((grad[hidden] == 0).all() for grad in actual_grads), f"scene {seed}"
    assert seen > 2000
    assert culled > 2000
    assert worst[:5].max() < 1e-10
    assert worst[5:].max() < 1e-8


def test_float32_agrees_with_float64():
    worst = np.zeros(9)
    for seed in range(20):
        camera = a_camera(seed=seed)
        gaussians = gaussians_before(camera, 100, seed=seed, spread=1.1)
        exact, exact_grads = _run(gaussians, camera, "numba", seed)
        rough, rough_grads = _run(gaussians.to(torch.float32), camera.to(torch.float32), "numba", seed)
        assert torch.equal(rough.index, exact.index)
        pairs = [*zip(rough[:5], exact[:5], strict=True), *zip(rough_grads, exact_grads, strict=True)]
        worst = np.maximum(worst, [_row_error(r.detach().double(), e.detach()) for r, e in pairs])
    assert worst[:5].max() < 2e-5
    assert worst[5:].max() < 1e-3  # of rows whose terms cancel


@pytest.mark.parametrize("dtype", DTYPES)
def test_threads_and_shares_and_order_do_not_matter(dtype, monkeypatch):
    camera = a_camera(dtype=dtype)
    gaussians = gaussians_before(camera, 1000, seed=5, spread=1.5)
    before, threads = _run(gaussians, camera, "numba"), torch.get_num_threads()
    expected = *before[0], *before[1]
    try:
        for share in (37, 100, 512, 16384):
            monkeypatch.setattr(numba_project, "_SHARE", share)
            for count in (1, 2, 5):
                torch.set_num_threads(count)
                after = _run(gaussians, camera, "numba")
                assert all(torch.equal(a, b) for a, b in zip((*after[0], *after[1]), expected, strict=True))
    finally:
        torch.set_num_threads(threads)
    order = torch.randperm(1000, generator=torch.Generator().manual_seed(0))
    shuffled = project(gaussians.select(order), camera)
    back = torch.argsort(order[shuffled.index])
    for value, expected in zip(shuffled[:5], before[0][:5], strict=True):
        assert torch.equal(value[back], expected)


@pytest.mark.parametrize("N", [1, 63, 64, 65, 128])
def test_any_number_of_gaussians_fills_the_batches(N):
    camera = a_camera()
    gaussians = gaussians_before(camera, N, seed=N, spread=0.9)
    (actual, actual_grads), (expected, expected_grads) = (_run(gaussians, camera, e) for e in ("numba", "reference"))
    assert actual.index.tolist() == expected.index.tolist()
    pairs = [*zip(actual[:5], expected[:5], strict=True), *zip(actual_grads, expected_grads, strict=True)]
    assert max(_row_error(a.detach(), e.detach()) for a, e in pairs) < 1e-11


def test_every_row_of_the_gradients_is_written():
    """Memory of an earlier call must not show through; freed blocks full of NaN are what `empty` returns next."""
    camera = a_camera()
    gaussians = gaussians_before(camera, 5000, seed=2, spread=4.0)
    for _ in range(3):
        projected, grads = _run(gaussians, camera, "numba")
        assert 0 < len(projected.index) < 4000
        assert all(torch.isfinite(v).all() for v in (*projected[:5], *grads))
        for grad in grads:
            grad.fill_(float("nan"))
        del projected, grads, grad


def test_only_what_is_asked_for_gets_a_gradient():
    camera = a_camera()
    gaussians = gaussians_before(camera, 20, seed=1)
    scales = gaussians.scales.clone().requires_grad_()
    project(gaussians.replace(scales=scales), camera, engine="numba").conics.sum().backward()
    assert scales.grad.abs().max() > 0
    projected = project(gaussians.replace(scales=scales), camera, engine="numba")
    assert not projected.extents.requires_grad
    assert not project(gaussians, camera, engine="numba").means2d.requires_grad


def test_gradients_of_gradients_are_refused():
    camera = a_camera()
    leaves = _leaves(gaussians_before(camera, 5, seed=1, spread=0.5))
    projected = project(Gaussians(*leaves), camera, engine="numba")
    (grad,) = torch.autograd.grad((projected.conics**2).sum(), leaves[2], create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        grad.sum().backward()


def test_inputs_may_be_strided():
    camera = a_camera()
    gaussians = gaussians_before(camera, 30, seed=1)
    strided = Gaussians(*(torch.stack([v, v], dim=-1)[..., 0] for v in _leaves(gaussians)))
    assert not strided.means.is_contiguous()
    turned = Camera(camera.viewmat.T.contiguous().T, camera.K, camera.width, camera.height)
    for a, b in zip(project(strided, turned, engine="numba"), project(gaussians, camera, engine="numba"), strict=True):
        assert torch.equal(a, b)


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="reads x86-64 assembly")
def test_batches_are_vectorised_and_stay_in_float32():
    lens = numba_project_forward.make_lens(Pinhole(torch.eye(4), torch.eye(3), 4, 4, 0.1, 0.3))
    for module, name in ((numba_project_forward, "_project_batch"), (numba_project_backward, "_differentiate_batch")):
        kernel = getattr(module, name)
        kernel.compile((numba.typeof(np.ones(module._STATE, np.float32)), numba.typeof(lens)))
        (text,) = (t for s, t in kernel.inspect_asm().items() if s[0].dtype == numba.float32)
        packed = len(re.findall(r"\bv?(?:mulps|fn?m(?:add|sub)\d+ps)\b", text))
        single = len(re.findall(r"\bv?(?:mulss|fn?m(?:add|sub)\d+ss)\b", text))
        assert packed > 60, f"{name} works on one Gaussian at a time"
        assert single < 5, f"{name} works on one Gaussian at a time"
        assert not re.search(r"\bv?cvt[sp]s2[sp]d\b", text), f"{name} computes in float64 what is float32"
