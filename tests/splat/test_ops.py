"""The engines' operators under torch's own checks, and a renderer compiled and exported."""

import io
import os
import shutil
import subprocess
import sys
import sysconfig
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from cases_splat import a_camera, gaussians_before
from messages import tells

from kfgs.cameras.camera import Camera
from kfgs.fields import Identity, SemanticField
from kfgs.gaussians import Gaussians
from kfgs.splat import accumulate_pixels, available_engines, bin_tiles, composite, project, rasterize
from kfgs.splat.engines import ops

pytestmark = pytest.mark.skipif(available_engines("cpu")[0] != "numba", reason="needs numba, the CPU's operators")

CHECKS = "test_schema", "test_autograd_registration", "test_faketensor", "test_aot_dispatch_dynamic"
"""opcheck's, less "test_aot_dispatch_static": how many Gaussians are seen depends on values, which that one rules out."""

VIEWS = [
    (0.0, 0.0, 0.0),
    (2.0, 0.0, 0.0),
    (0.0, 0.0, 3.0),
    (0.0, 0.0, -100.0),
]  # moves of the camera; the last sees nothing

every_dtype = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


@pytest.fixture(autouse=True)
def _own_compiler():
    """Each test compiles for itself; sizes that depend on values are captured (with fullgraph they are anyway)."""
    import torch._dynamo  # seconds, which no other process that collects the tests needs

    torch._dynamo.reset()
    with torch._dynamo.config.patch(capture_dynamic_output_shape_ops=True):
        yield
    torch._dynamo.reset()


def _scene(dtype=torch.float32, N=40):
    camera = a_camera(dtype=dtype)
    return gaussians_before(camera, N, seed=1, spread=1.5).to(dtype), camera


def _moved(camera, move):
    viewmat = camera.viewmat.clone()
    viewmat[:3, 3] += viewmat.new_tensor(move)
    return replace(camera, viewmat=viewmat)


def _leaves(*values):
    return [value.detach().clone().requires_grad_() for value in values]


def _values(gaussians):
    return gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.features


def _loss(means, quats, scales, opacities, features, viewmat, K):
    camera = Camera(viewmat, K, 24, 18)
    seen = rasterize(Gaussians(means, quats, scales, opacities, features=features), camera)
    return (seen.map - 0.3).square().mean() + seen.alpha.mean()


class Renderer(torch.nn.Module):
    """Gaussians as parameters, seen by the camera that is given."""

    def __init__(self, gaussians):
        super().__init__()
        names = ("means", "quats", "scales", "opacities", "features")
        self.values = torch.nn.ParameterDict(dict(zip(names, _leaves(*_values(gaussians)), strict=True)))

    def forward(self, viewmat, K):
        seen = rasterize(Gaussians(**self.values), Camera(viewmat, K, 24, 18))
        return seen.map, seen.alpha


# What torch asks of an operator -------------------------------------------------------------------------------------


@every_dtype
@pytest.mark.parametrize("with_index", [True, False])
def test_composite_passes_opcheck(dtype, with_index):
    gaussians, camera = _scene(dtype)
    seen = project(gaussians, camera)
    tiles = bin_tiles(seen, 24, 18)
    features = gaussians.features if with_index else gaussians.features[seen.index]
    inputs = _leaves(seen.means2d, seen.conics, seen.opacities, features, torch.tensor([0.5, -1, 2], dtype=dtype))
    index = seen.index if with_index else None
    torch.library.opcheck(ops.composite, (*inputs, index, *tiles, "numba"), test_utils=CHECKS)


@every_dtype
def test_project_passes_opcheck(dtype):
    gaussians, camera = _scene(dtype)
    inputs = _leaves(*_values(gaussians)[:4])
    torch.library.opcheck(
        ops.project, (*inputs, camera.viewmat, camera.K, 24, 18, 0.2, 0.3, "numba"), test_utils=CHECKS
    )


@every_dtype
def test_shade_passes_opcheck(dtype):
    gaussians, camera = _scene(dtype)
    sh = torch.randn(len(gaussians), 9, 3, generator=torch.Generator().manual_seed(1)).to(dtype)
    inputs = *_leaves(sh, gaussians.means), camera.center, torch.arange(0, len(gaussians), 2), "numba"
    torch.library.opcheck(ops.shade, inputs, test_utils=CHECKS)


@every_dtype
def test_bin_tiles_and_accumulate_pass_opcheck(dtype):
    gaussians, camera = _scene(dtype)
    seen = project(gaussians, camera)
    torch.library.opcheck(ops.bin_tiles, (*seen[:5], 24, 18, 16, "numba"), test_utils=CHECKS)
    pixels = torch.ones(18, 24, 5, dtype=dtype)
    splats = seen.means2d, seen.conics, seen.opacities
    tiles = bin_tiles(seen, 24, 18)
    torch.library.opcheck(ops.accumulate, (*splats, pixels, *tiles, "numba"), test_utils=CHECKS)


def test_trace_has_one_dimension_as_its_fake_has():
    gaussians, camera = _scene()
    seen = project(gaussians, camera)
    splats = seen.means2d, seen.conics, seen.opacities, gaussians.features, torch.zeros(3)
    trace = ops.composite(*splats, seen.index, *bin_tiles(seen, 24, 18), "numba")[2]
    assert (trace.dim(), trace.dtype) == (1, torch.int32)


@pytest.mark.parametrize("part", ["project", "composite"])
def test_gradient_of_a_gradient_is_refused(part):
    gaussians, camera = _scene()
    leaf = (
        gaussians.means.clone().requires_grad_() if part == "project" else gaussians.features.clone().requires_grad_()
    )
    if part == "project":
        value = project(gaussians.replace(means=leaf), camera, engine="numba").conics.square().sum()
    else:
        value = rasterize(gaussians.replace(features=leaf), camera, engine="numba").map.square().sum()
    (grad,) = torch.autograd.grad(value, leaf, create_graph=True)
    with pytest.raises(NotImplementedError, match=tells("backward:", "order", "create_graph=True")):
        grad.square().sum().backward()


# torch.compile ------------------------------------------------------------------------------------------------------


def _compositing_loss():
    gaussians, camera = _scene()
    seen = project(gaussians, camera)
    tiles = bin_tiles(seen, 24, 18)

    def loss(means2d, conics, opacities, features):
        maps, alphas = composite(means2d, conics, opacities.sigmoid(), features, tiles, index=seen.index)
        return (maps - 0.3).abs().mean() + alphas.square().mean()

    return loss, (seen.means2d, seen.conics, seen.opacities.logit(), gaussians.features)


def _assert_same_loss_and_gradients(compiled, loss, values, *others):
    ours, expected = _leaves(*values), _leaves(*values)
    for function, inputs in ((compiled, ours), (loss, expected)):
        inputs.append(function(*inputs, *others))
        inputs[-1].backward()
    torch.testing.assert_close(ours[-1], expected[-1], rtol=1e-6, atol=1e-7)
    for got, wanted in zip(ours[:-1], expected[:-1], strict=True):
        torch.testing.assert_close(got.grad, wanted.grad, rtol=1e-5, atol=1e-7)
    return expected[:-1]


def test_compiled_compositing_has_eager_gradients():
    loss, values = _compositing_loss()
    leaves = _assert_same_loss_and_gradients(torch.compile(loss, fullgraph=True, backend="aot_eager"), loss, values)
    assert all(leaf.grad.abs().max() > 1e-4 for leaf in leaves)


def _can_compile():
    """Whether inductor finds a C++ compiler, and Python's headers."""
    return shutil.which(os.environ.get("CXX", "g++")) and Path(sysconfig.get_path("include"), "Python.h").exists()


@pytest.mark.skipif(not _can_compile(), reason="inductor needs a C++ compiler and Python's headers")
def test_compositing_goes_through_inductor():
    import torch._inductor.config as inductor

    loss, values = _compositing_loss()
    known = {"cpp.vec_isa_ok": True}  # else it compiles trials for each vector unit that the processor says it has
    with warnings.catch_warnings(), inductor.patch(known):
        warnings.simplefilter("ignore", DeprecationWarning)  # inductor imports torch.jit's
        _assert_same_loss_and_gradients(torch.compile(loss, fullgraph=True), loss, values)


@pytest.mark.parametrize("dynamic", [None, True])
def test_compiled_renderer_follows_the_camera_in_one_graph(dynamic):
    gaussians, camera = _scene()
    compiled, graphs = _counting(_loss, dynamic=dynamic)
    counts, made = set(), []
    for move in VIEWS:
        there = _moved(camera, move)
        counts.add(len(project(gaussians, there).index))
        _assert_same_loss_and_gradients(compiled, _loss, _values(gaussians), there.viewmat, there.K)
        made.append(len(graphs))
    assert len(counts) == len(VIEWS)
    assert 0 in counts
    assert made[0] == made[-1]  # the first may be begun anew while it is made


def _counting(function, **options):
    """The function compiled without a graph break, and a list that grows with every graph."""

    from torch._dynamo.backends.debugging import aot_eager

    graphs = []

    def backend(graph, inputs):
        graphs.append(graph)
        return aot_eager(graph, inputs)

    return torch.compile(function, fullgraph=True, backend=backend, **options), graphs


def test_compiled_renderer_follows_the_near_plane_of_a_camera():
    gaussians, camera = _scene()
    depths = project(gaussians, camera).depths.sort().values
    compiled, _ = _counting(lambda gaussians, camera: rasterize(gaussians, camera).map)
    pictures = []
    for k in (0, 10, 20):
        there = replace(camera, near=0.2 if k == 0 else float((depths[k] + depths[k + 1]) / 2))
        pictures.append(rasterize(gaussians, there).map)
        torch.testing.assert_close(compiled(gaussians, there), pictures[-1], rtol=1e-6, atol=1e-7)
    assert (pictures[0] - pictures[1]).abs().max() > 0.05
    assert (pictures[1] - pictures[2]).abs().max() > 0.05


def test_compiled_renderer_survives_a_growing_field():
    gaussians, camera = _scene()
    compiled, graphs = _counting(_loss)
    made = []
    for N in (20, 25, 31, 40):  # densification adds Gaussians
        values = [value[:N] for value in _values(gaussians)]
        _assert_same_loss_and_gradients(compiled, _loss, values, camera.viewmat, camera.K)
        made.append(len(graphs))
    assert made[0] < made[1] == made[-1]  # the second graph is for any number


def test_compiled_colour_field_equals_eager():
    gaussians, camera = _scene()
    sh = torch.randn(len(gaussians), 9, 3, generator=torch.Generator().manual_seed(0))

    def loss(sh):
        return rasterize(gaussians.replace(features=None, sh=sh), camera).map.square().mean()

    _assert_same_loss_and_gradients(torch.compile(loss, fullgraph=True, backend="aot_eager"), loss, [sh])


def test_compiled_pose_has_a_gradient():
    gaussians, camera = _scene(torch.float64)

    def loss(viewmat):  # by kornia's projection
        return _loss(*_values(gaussians), viewmat, camera.K)

    compiled = torch.compile(loss, fullgraph=True, backend="eager")
    (leaf,) = _assert_same_loss_and_gradients(compiled, loss, [camera.viewmat])
    assert leaf.grad.abs().max() > 1e-4


def test_reference_engine_breaks_the_graph_and_is_right():
    gaussians, camera = _scene(N=8)

    def draw(gaussians):
        return rasterize(gaussians, camera, engine="reference").map

    compiled = torch.compile(draw, backend="eager")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # dynamo's own, where the graph breaks
        ours = compiled(gaussians)
    torch.testing.assert_close(ours, draw(gaussians), rtol=0, atol=0)


def test_compiled_accumulation_equals_eager():
    gaussians, camera = _scene()
    seen = project(gaussians, camera)
    tiles = bin_tiles(seen, 24, 18)

    def gather(pixels):
        return accumulate_pixels(seen.means2d, seen.conics, seen.opacities, pixels * 2, tiles)

    pixels = torch.rand(18, 24, 5, generator=torch.Generator().manual_seed(0))
    ours = torch.compile(gather, fullgraph=True, backend="aot_eager")(pixels)
    for got, wanted in zip(ours, gather(pixels), strict=True):
        torch.testing.assert_close(got, wanted, rtol=0, atol=0)
    assert ours[1].sum() > 1


def test_compiled_semantic_field_renders():
    gaussians, camera = _scene()
    field = SemanticField(gaussians, Identity(gaussians.features.shape[1]))
    compiled = torch.compile(lambda camera: field.render(camera).map, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(camera), field.render(camera).map, rtol=0, atol=0)


def test_compiled_operator_refuses_foreign_rows():
    gaussians, camera = _scene()
    seen = project(gaussians, camera)
    tiles = bin_tiles(seen, 24, 18)

    def draw(rows):
        splats = seen.means2d, seen.conics, seen.opacities, gaussians.features
        return composite(*splats, tiles._replace(rows=rows), index=seen.index)[0]

    compiled = torch.compile(draw, fullgraph=True, backend="aot_eager")
    with pytest.raises(ValueError, match=tells("tiles.rows:", "M = 39", "got 10")):
        compiled(tiles.rows + 1000)


def test_compiled_shapes_that_disagree_raise():
    gaussians, camera = _scene()

    def draw(background):
        return rasterize(gaussians, camera, background=background).map

    with pytest.raises(torch._dynamo.exc.Unsupported, match=tells("background:", "[D]", "D = 3", "got (4,)")):
        torch.compile(draw, fullgraph=True, backend="aot_eager")(torch.zeros(4))


# torch.export -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("strict", [False, True])
def test_exported_renderer_follows_the_camera(strict):
    gaussians, camera = _scene()
    renderer = Renderer(gaussians)
    program = torch.export.export(renderer, (camera.viewmat, camera.K), strict=strict).module()
    for move in VIEWS:
        there = _moved(camera, move)
        for ours, expected in zip(program(there.viewmat, there.K), renderer(there.viewmat, there.K), strict=True):
            torch.testing.assert_close(ours, expected, rtol=0, atol=0)


def test_saved_program_runs_in_a_process_that_imports_only_splat(tmp_path):
    gaussians, camera = _scene()
    renderer, there = Renderer(gaussians), _moved(camera, VIEWS[1])
    program = torch.export.export(renderer, (camera.viewmat, camera.K))
    buffer = io.BytesIO()
    torch.export.save(program, buffer)
    buffer.seek(0)
    expected = renderer(there.viewmat, there.K)[0].detach()
    torch.testing.assert_close(torch.export.load(buffer).module()(there.viewmat, there.K)[0], expected)

    (tmp_path / "renderer.pt2").write_bytes(buffer.getvalue())
    torch.save((there.viewmat, there.K, expected), tmp_path / "view.pt")
    script = (
        "import sys, torch, kfgs.splat\n"
        "program = torch.export.load(sys.argv[1] + '/renderer.pt2').module()\n"
        "viewmat, K, expected = torch.load(sys.argv[1] + '/view.pt')\n"
        "assert torch.equal(program(viewmat, K)[0], expected)\n"
    )
    run = subprocess.run([sys.executable, "-c", script, str(tmp_path)], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


# Cost ---------------------------------------------------------------------------------------------------------------


def test_rendering_does_not_import_the_compiler():
    """It takes a second, which torch.library.custom_op would spend at an operator's first call."""
    script = """
import sys, torch, kfgs
camera = kfgs.Camera(torch.eye(4), torch.tensor([[10.0, 0, 2], [0, 10, 2], [0, 0, 1]]), 4, 4)
values = torch.tensor([[0.0, 0, 2]]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.1), torch.tensor([0.5])
ball = kfgs.Gaussians(*values, features=torch.ones(1, 2, requires_grad=True))
kfgs.rasterize(ball, camera).map.sum().backward()
assert ball.features.grad.sum() > 0.1
assert "torch._dynamo" not in sys.modules
"""
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
