"""The promises of `kfgs.splat.engines.contract`, asked of every engine that is installed."""

import importlib.machinery
import sys
import types

import numpy as np
import pytest
import torch
from cases_splat import random_splats
from messages import refused, tells

from kfgs.splat import Tiles, accumulate_pixels, available_engines, bin_tiles, composite
from kfgs.splat.engines import table
from kfgs.splat.engines.contract import Engine

ENGINES = available_engines("cpu")  # what runs on a GPU is asked the same in test_triton.py

every_engine = pytest.mark.parametrize("engine", ENGINES)
every_dtype = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def _run(projected, features, width, height, *, tile_size=16, **options):
    tiles = bin_tiles(projected, width, height, tile_size)
    return composite(projected.means2d, projected.conics, projected.opacities, features, tiles, **options)


def _stack(opacities, dtype=torch.float64):
    """Flat Gaussians, one behind the other, that cover one tile: alpha is the opacity everywhere (to 1e-10)."""
    M = len(opacities)
    means2d, conics = torch.full((M, 2), 8.0, dtype=dtype), torch.tensor([[1e-13, 0, 1e-13]], dtype=dtype).repeat(M, 1)
    tiles = Tiles(torch.arange(M, dtype=torch.int32), torch.tensor([0, M]), 16, 16, 16)
    return means2d, conics, torch.tensor(opacities, dtype=dtype), tiles


def _gradients(inputs, tiles, cotangents, engine):
    """Gradients of all five inputs, for fixed cotangents of maps and alphas."""
    inputs = [v.detach().clone().requires_grad_() for v in inputs]
    outputs = composite(*inputs[:4], tiles, background=inputs[4], engine=engine)
    return torch.autograd.grad(outputs, inputs, cotangents)


# 1. pixels and density ------------------------------------------------------------------------------------------------


@every_engine
@every_dtype
def test_first_pixel_centre_is_one_half(engine, dtype):
    means2d = torch.tensor([[2.5, 1.5]], dtype=dtype)
    conics = torch.tensor([[2.0, 0.0, 8.0]], dtype=dtype)  # narrower in y
    tiles = Tiles(torch.zeros(1, dtype=torch.int32), torch.tensor([0, 1]), 8, 6, 16)
    one = torch.ones(1, 1, dtype=dtype)
    maps, alphas = composite(means2d, conics, 0.7 * one[0], one, tiles, engine=engine)
    expected = torch.zeros(6, 8, dtype=dtype)
    for j, step in ((2, 0), (1, 1), (3, 1), (0, 2), (4, 2)):
        expected[1, j] = 0.7 * np.exp(-0.5 * 2.0 * step**2)
    expected[[0, 2], 2] = 0.7 * np.exp(-0.5 * 8.0)
    expected[[0, 0, 2, 2], [1, 3, 1, 3]] = 0.7 * np.exp(-0.5 * 10.0)
    expected[expected < 1 / 255] = 0
    torch.testing.assert_close(alphas, expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(maps[..., 0], expected, rtol=0, atol=1e-6)


# 2. the three constants -----------------------------------------------------------------------------------------------


@every_engine
@every_dtype
def test_alpha_is_clamped_and_then_has_no_gradient(engine, dtype):
    means2d, conics, opacities, tiles = _stack([0.999], dtype)
    features = torch.tensor([[2.0, -1.0]], dtype=dtype)
    _, alphas = composite(means2d, conics, opacities, features, tiles, engine=engine)
    torch.testing.assert_close(alphas, torch.full_like(alphas, 0.99), rtol=0, atol=1e-6)
    inputs = (means2d, conics, opacities, features, torch.ones(2, dtype=dtype))
    cotangents = (torch.ones(16, 16, 2, dtype=dtype), torch.ones(16, 16, dtype=dtype))
    *shape, of_features, of_background = _gradients(inputs, tiles, cotangents, engine)
    assert all((g == 0).all() for g in shape)
    torch.testing.assert_close(
        of_features, torch.full_like(of_features, 256 * 0.99), rtol=1e-5, atol=0
    )  # 256 roundings
    torch.testing.assert_close(of_background, torch.full_like(of_background, 256 * 0.01), rtol=1e-4, atol=0)


@every_engine
@every_dtype
def test_alpha_below_one_step_is_skipped(engine, dtype):
    means2d, conics, opacities, tiles = _stack([0.999 / 255, 1.001 / 255], dtype)
    inputs = (means2d, conics, opacities, torch.tensor([[100.0], [1.0]], dtype=dtype), torch.zeros(1, dtype=dtype))
    maps, alphas = composite(*inputs[:4], tiles, engine=engine)
    torch.testing.assert_close(alphas, torch.full_like(alphas, 1.001 / 255), rtol=1e-4, atol=0)
    torch.testing.assert_close(maps[..., 0], alphas)
    for grad in _gradients(inputs, tiles, (torch.ones_like(maps), torch.ones_like(alphas)), engine)[:4]:
        assert (grad[0] == 0).all()
    assert _gradients(inputs, tiles, (torch.ones_like(maps), torch.ones_like(alphas)), engine)[2][1] > 0


@every_engine
@every_dtype
def test_pixel_stops_before_its_transmittance_falls_below_the_limit(engine, dtype):
    # 0.1^3 = 1e-3 is left; the fourth would leave 5e-5, so it is not drawn, nor the fifth, which would leave 9e-4
    means2d, conics, opacities, tiles = _stack([0.9, 0.9, 0.9, 0.95, 0.1], dtype)
    features = torch.eye(5, dtype=dtype)
    maps, alphas = composite(means2d, conics, opacities, features, tiles, engine=engine)
    expected = torch.tensor([0.9, 0.09, 0.009, 0, 0], dtype=dtype)
    torch.testing.assert_close(maps, expected.expand(16, 16, 5), rtol=1e-5, atol=0)
    torch.testing.assert_close(1 - alphas, torch.full_like(alphas, 1e-3), rtol=1e-4, atol=0)
    inputs = (means2d, conics, opacities, features, torch.ones(5, dtype=dtype))
    grads = _gradients(inputs, tiles, (torch.ones_like(maps), torch.ones_like(alphas)), engine)
    for grad in grads[:4]:
        assert (grad[3:] == 0).all()
    assert (grads[3][:3] > 0).any(dim=1).all()
    torch.testing.assert_close(grads[4], torch.full_like(grads[4], 256 * 1e-3), rtol=1e-4, atol=0)


# 3. order and repeatability -------------------------------------------------------------------------------------------


@every_engine
def test_nearer_hides_further_and_ties_go_by_index(engine):
    projected, _ = random_splats(3, 16, 16, seed=0)
    flat = torch.tensor([[1e-13, 0, 1e-13]], dtype=torch.float64).repeat(3, 1)
    projected = projected._replace(
        means2d=torch.full((3, 2), 8.0).double(),
        conics=flat,
        depths=torch.tensor([2.0, 1.0, 2.0], dtype=torch.float64),
        opacities=torch.tensor([0.5, 0.6, 0.7], dtype=torch.float64),
        extents=torch.full((3, 2), 100.0).double(),
    )
    maps, _ = _run(projected, torch.eye(3).double(), 16, 16, engine=engine)
    expected = torch.tensor([0.4 * 0.5, 0.6, 0.4 * 0.5 * 0.7], dtype=torch.float64)
    torch.testing.assert_close(maps, expected.expand(16, 16, 3), rtol=1e-8, atol=0)


@every_engine
@every_dtype
def test_equal_input_gives_bit_equal_output(engine, dtype):
    projected, features = random_splats(400, 64, 48, seed=12, dtype=dtype, channels=5)
    tiles = bin_tiles(projected, 64, 48)
    inputs = (projected.means2d, projected.conics, projected.opacities, features, torch.ones(5, dtype=dtype))
    g = torch.Generator().manual_seed(0)
    cotangents = (torch.randn(48, 64, 5, generator=g, dtype=dtype), torch.randn(48, 64, generator=g, dtype=dtype))
    first = composite(*inputs[:4], tiles, engine=engine), _gradients(inputs, tiles, cotangents, engine)
    for _ in range(3):
        again = composite(*inputs[:4], tiles, engine=engine), _gradients(inputs, tiles, cotangents, engine)
        for a, b in zip((*first[0], *first[1]), (*again[0], *again[1]), strict=True):
            assert torch.equal(a, b)


# 4. gradients ---------------------------------------------------------------------------------------------------------


@every_engine
@pytest.mark.parametrize("channels", [1, 3, 18])
def test_gradients(engine, channels):
    projected, features = random_splats(10, 8, 8, seed=13, opacities=(0.2, 0.8), sigma=(1.0, 4.0), channels=channels)
    tiles = bin_tiles(projected, 8, 8)
    background = torch.linspace(-1, 1, channels).double()
    inputs = [projected.means2d, projected.conics, projected.opacities, features, background]

    def run(means2d, conics, opacities, features, background):
        return composite(means2d, conics, opacities, features, tiles, background=background, engine=engine)

    # fast: one random direction, which is enough to see that many channels are treated alike
    assert torch.autograd.gradcheck(run, [v.clone().requires_grad_() for v in inputs], fast_mode=channels > 1)


@every_engine
@pytest.mark.parametrize("channels", [3, 9, 20, 40])
def test_a_gaussian_that_stops_a_pixel_hides_what_is_behind_it(engine, channels):
    # The third leaves T' = 0.1 * 0.05 * 0.015 < 1e-4 at the only pixel that it touches: it is not drawn, nor is the fourth.
    means2d = torch.tensor([[0.5, 0.5]] * 3 + [[2.0, 2.0]], dtype=torch.float64)
    conics = torch.tensor([[11.1, 0, 11.1]] * 3 + [[0.01, 0, 0.01]], dtype=torch.float64)
    opacities = torch.tensor([0.9, 0.95, 0.985, 0.5], dtype=torch.float64).requires_grad_()
    features = torch.ones(4, channels, dtype=torch.float64).requires_grad_()
    tiles = Tiles(torch.arange(4, dtype=torch.int32), torch.tensor([0, 4]), 4, 4, 16)
    maps, _ = composite(means2d, conics, opacities, features, tiles, engine=engine)
    of_features, of_opacities = torch.autograd.grad(maps[0, 0].sum(), (features, opacities))
    expected = torch.tensor([0.9, 0.095, 0, 0], dtype=torch.float64)
    torch.testing.assert_close(of_features, expected[:, None].expand(4, channels), rtol=0, atol=1e-12)
    assert of_opacities[2:].abs().max() == 0


@every_engine
def test_only_what_asks_for_a_gradient_gets_one(engine):
    projected, features = random_splats(20, 16, 16, seed=16)
    features.requires_grad_()
    maps, alphas = _run(projected, features, 16, 16, engine=engine)
    (maps.sum() + alphas.sum()).backward()
    assert features.grad.abs().sum() > 0
    assert projected.means2d.grad is None


# 5., 6. sizes, dtypes, manners ----------------------------------------------------------------------------------------


@every_engine
@every_dtype
def test_without_gaussians_there_is_the_background(engine, dtype):
    projected, features = random_splats(0, 20, 10, seed=0, dtype=dtype, channels=4)
    background = torch.tensor([1.0, 2.0, 3.0, 4.0], dtype=dtype, requires_grad=True)
    maps, alphas = _run(projected, features.requires_grad_(), 20, 10, background=background, engine=engine)
    assert torch.equal(maps, background.expand(10, 20, 4))
    assert torch.equal(alphas, torch.zeros(10, 20, dtype=dtype))
    maps.sum().backward()
    assert torch.equal(background.grad, torch.full((4,), 200.0, dtype=dtype))


@every_engine
def test_empty_tiles_show_the_background(engine):
    means2d, conics, opacities, _ = _stack([0.5])
    tiles = Tiles(torch.zeros(1, dtype=torch.int32), torch.tensor([0, 0, 1]), 32, 16, 16)  # the right one is covered
    background = torch.tensor([7.0], dtype=torch.float64)
    maps, alphas = composite(
        means2d, conics, opacities, opacities[:, None], tiles, background=background, engine=engine
    )
    assert (maps[:, :16] == 7).all()
    assert (alphas[:, :16] == 0).all()
    torch.testing.assert_close(maps[:, 16:], torch.full((16, 16, 1), 3.75).double())


@every_engine
def test_inputs_may_be_views_and_are_left_alone(engine):
    projected, features = random_splats(30, 20, 10, seed=17)
    inputs = [projected.means2d, projected.conics, projected.opacities, features]
    views = [torch.stack([v, v + 1], dim=-1)[..., 0] for v in inputs]
    assert not any(v.is_contiguous() for v in views)
    tiles = bin_tiles(projected, 20, 10)
    for a, b in zip(composite(*views, tiles, engine=engine), composite(*inputs, tiles, engine=engine), strict=True):
        assert torch.equal(a, b)
    for view, value in zip(views, inputs, strict=True):
        assert torch.equal(view, value)


# 7. weights against pixels --------------------------------------------------------------------------------------------


@every_engine
def test_pixels_are_accumulated_in_inference_mode(engine):
    projected, _ = random_splats(30, 20, 14, seed=23)
    pixels = torch.randn(14, 20, 4, generator=torch.Generator().manual_seed(2)).double()
    tiles = bin_tiles(projected, 20, 14)
    expected, _ = accumulate_pixels(*projected[:2], projected.opacities, pixels, tiles, engine=engine)
    with torch.inference_mode():
        inside = type(projected)(*(value.clone() for value in projected))  # inference tensors, as a render there makes
        tiles = bin_tiles(inside, 20, 14)
        sums, _ = accumulate_pixels(*inside[:2], inside.opacities, pixels.clone(), tiles, engine=engine)
    assert torch.equal(sums, expected)


def test_pixels_must_fill_the_image():
    projected, _ = random_splats(5, 20, 14, seed=0)
    splats = projected.means2d, projected.conics, projected.opacities
    with pytest.raises(ValueError, match=tells("pixels:", "[14, 20, D]", "got (20, 14, 3)")):
        accumulate_pixels(*splats, torch.zeros(20, 14, 3).double(), bin_tiles(projected, 20, 14))


# the table ------------------------------------------------------------------------------------------------------------


def test_reference_is_always_there():
    assert "reference" in ENGINES
    assert ENGINES[-1] == "reference"  # and the last choice


@pytest.fixture
def other_engines(monkeypatch):
    """The table, which a test may change."""
    monkeypatch.setattr(table, "_ENGINES", dict(table._ENGINES))
    for function in (table.load, table.choose):
        function.cache_clear()
    yield table._ENGINES
    for function in (table.load, table.choose):
        function.cache_clear()


@pytest.fixture
def _without_numba(other_engines):
    other_engines["numba"] = table._Entry("kfgs.splat.engines.absent", "surely_not_installed", "cpu")


@pytest.fixture
def single(other_engines, monkeypatch):
    """An engine for float32 alone, before all others."""
    engine, module = Engine(), types.ModuleType("single_precision")
    engine.dtypes, engine.devices, module.ENGINE = (torch.float32,), ("cpu",), engine
    module.__spec__ = importlib.machinery.ModuleSpec("single_precision", None)
    monkeypatch.setitem(sys.modules, "single_precision", module)
    others = dict(other_engines)
    other_engines.clear()
    other_engines.update({"single": table._Entry("single_precision", "torch", "cpu"), **others})
    return engine


@pytest.mark.usefixtures("_without_numba")
def test_missing_engine_raises_with_the_install_line_and_auto_goes_on():
    projected, features = random_splats(20, 16, 16, seed=24)
    assert "numba" not in available_engines()
    assert available_engines("cpu") == ["reference"]
    with pytest.raises(
        ImportError, match=tells("engine:", "surely_not_installed", "`pip install surely_not_installed`")
    ):
        _run(projected, features, 16, 16, engine="numba")
    maps, _ = _run(projected, features, 16, 16)
    assert torch.equal(maps, _run(projected, features, 16, 16, engine="reference")[0])


def test_engine_must_be_known():
    projected, features = random_splats(5, 16, 16, seed=0)
    with pytest.raises(ValueError, match=tells("engine:", "'auto', 'triton', 'numba', 'reference'", "got 'cuda'")):
        _run(projected, features, 16, 16, engine="cuda")


def test_engine_must_run_on_the_device():
    refused(lambda: table.choose("numba", "cuda", torch.float32), "engine:", "cuda", "got 'numba'", "cpu")


def test_auto_passes_over_an_engine_that_does_not_know_the_dtype(single):
    assert table.choose("auto", "cpu", torch.float32) is single
    assert table.choose("auto", "cpu", torch.float64) is table.load(ENGINES[0])
    with pytest.raises(ValueError, match=tells("engine:", "torch.float64", "got 'single'", "torch.float32", "'auto'")):
        table.choose("single", "cpu", torch.float64)


def test_shapes_must_agree():
    projected, features = random_splats(5, 16, 16, seed=0)
    refused(lambda: _run(projected, features[:4], 16, 16), "features:", "[M, D]", "M = 5", "means2d", "got (4, 3)")
    with pytest.raises(ValueError, match=tells("background:", "[D]", "D = 3", "got (1,)")):
        _run(projected, features, 16, 16, background=features[0, :1])


def test_dtypes_must_agree():
    projected, features = random_splats(5, 16, 16, seed=0)
    with pytest.raises(ValueError, match=tells("features:", "torch.float64", "means2d", "got torch.float32")):
        _run(projected, features.float(), 16, 16)
    half = type(projected)(*(v.half() for v in projected[:5]), projected.index)
    refused(lambda: _run(half, features.half(), 16, 16), "means2d:", "float32", "float64", "got torch.float16")


def test_tiles_must_be_of_these_gaussians():
    projected, features = random_splats(50, 16, 16, seed=0)
    tiles = bin_tiles(projected, 16, 16)
    few = type(projected)(*(v[:7] for v in projected))
    with pytest.raises(ValueError, match=tells("tiles.rows:", "M = 7", "got 49")):
        composite(few.means2d, few.conics, few.opacities, features[:7], tiles)
    with pytest.raises(ValueError, match=tells("tiles.offsets:", "[3]", "got (2,)")):
        composite(*projected[:2], projected.opacities, features, tiles._replace(width=32))


@pytest.mark.parametrize(
    ("rows", "offsets", "message"),
    [
        ([0, -1], [0, 1, 2], ("tiles.rows:", "M = 5", "got -1")),
        ([0, 1], [1, 1, 2], ("tiles.offsets:", "P = 2", "got [1, 1, 2]")),
        ([0, 1], [0, 1, 9], ("tiles.offsets:", "P = 2", "9")),
        ([0, 1], [0, 3, 2], ("tiles.offsets:", "P = 2", "got [0, 3, 2]")),
        ([0.0, 1.0], [0, 1, 2], ("tiles.rows:", "int32", "int64", "got torch.float32")),
        ([0, 1], [0.0, 1.0, 2.0], ("tiles.offsets:", "int32", "int64", "got torch.float32")),
    ],
)
def test_malformed_tiles_are_refused(rows, offsets, message):
    projected, features = random_splats(5, 32, 16, seed=0)
    tiles = Tiles(torch.tensor(rows), torch.tensor(offsets), 32, 16, 16)
    refused(lambda: composite(*projected[:2], projected.opacities, features, tiles), *message)
