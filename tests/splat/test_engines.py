"""The promises of `kfgs.splat.engines.contract`, asked of every engine that is installed."""

import pytest
import torch
from cases_splat import random_splats
from messages import refused, tells

from kfgs.splat import Tiles, accumulate_pixels, available_engines, bin_tiles, composite
from kfgs.splat.engines import table

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
    torch.testing.assert_close(of_features, torch.full_like(of_features, 256 * 0.99), rtol=1e-5, atol=0)
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
def test_only_what_asks_for_a_gradient_gets_one(engine):
    projected, features = random_splats(20, 16, 16, seed=16)
    features.requires_grad_()
    maps, alphas = _run(projected, features, 16, 16, engine=engine)
    (maps.sum() + alphas.sum()).backward()
    assert features.grad.abs().sum() > 0
    assert projected.means2d.grad is None


# 5., 6. sizes, dtypes, manners ----------------------------------------------------------------------------------------


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
def _without_numba(monkeypatch):
    others = table._ENGINES | {"numba": table._Entry("kfgs.splat.engines.absent", "surely_not_installed", "cpu")}
    for function in (table.load, table.choose):
        function.cache_clear()
    with monkeypatch.context() as patch:
        patch.setattr(table, "_ENGINES", others)
        yield
    for function in (table.load, table.choose):
        function.cache_clear()


@pytest.mark.usefixtures("_without_numba")
def test_missing_engine_raises_with_the_install_line_and_auto_goes_on():
    projected, features = random_splats(20, 16, 16, seed=24)
    assert "numba" not in available_engines()
    assert available_engines("cpu") == ["reference"]
    with pytest.raises(ImportError, match=tells("engine:", "`pip install surely_not_installed`")):
        _run(projected, features, 16, 16, engine="numba")
    maps, _ = _run(projected, features, 16, 16)
    assert torch.equal(maps, _run(projected, features, 16, 16, engine="reference")[0])


def test_engine_must_be_known():
    projected, features = random_splats(5, 16, 16, seed=0)
    with pytest.raises(ValueError, match=tells("engine:", "'auto', 'triton', 'numba', 'reference'", "got 'cuda'")):
        _run(projected, features, 16, 16, engine="cuda")


def test_engine_must_run_on_the_device():
    refused(lambda: table.choose("numba", "cuda", torch.float32), "engine:", "cuda", "got 'numba'", "cpu")


def test_shapes_must_agree():
    projected, features = random_splats(5, 16, 16, seed=0)
    refused(lambda: _run(projected, features[:4], 16, 16), "features:", "[M, D]", "M = 5", "means2d", "got (4, 3)")
    refused(lambda: _run(projected, features, 16, 16, background=features[0, :1]), "background:", "D = 3", "got (1,)")


def test_dtypes_must_agree():
    projected, features = random_splats(5, 16, 16, seed=0)
    refused(lambda: _run(projected, features.float(), 16, 16), "features:", "torch.float64", "got torch.float32")
    half = type(projected)(*(v.half() for v in projected[:5]), projected.index)
    refused(lambda: _run(half, features.half(), 16, 16), "means2d:", "float32", "float64", "got torch.float16")


def test_tiles_must_be_of_these_gaussians():
    projected, features = random_splats(50, 16, 16, seed=0)
    tiles = bin_tiles(projected, 16, 16)
    few = type(projected)(*(v[:7] for v in projected))
    refused(lambda: composite(few.means2d, few.conics, few.opacities, features[:7], tiles), "tiles.rows:", "got 49")
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
