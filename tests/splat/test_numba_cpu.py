"""The numba engine beyond the contract that `test_engines.py` asks of every engine: its arithmetic, runs and threads."""

import platform
import re
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import oracles_splat as oracle
import pytest
import torch
from cases_splat import TOLERANCE, assert_close_but_for_thresholds, random_splats, splats_from

from kfgs.splat import Tiles, bin_tiles

numba = pytest.importorskip("numba")
cells = pytest.importorskip("kfgs.splat.engines.numba_cells")

from kfgs.splat.engines import numba_cpu  # noqa: E402
from kfgs.splat.engines.numba_exp import exp_negative  # noqa: E402

DTYPES = [torch.float32, torch.float64]


def _needles(M, width, height, dtype, seed=3):
    """Gaussians from a twentieth of a pixel to 200 pixels, up to 4000 times longer than wide, in all directions."""
    g = torch.Generator().manual_seed(seed)
    angle = torch.rand(M, generator=g, dtype=torch.float64) * torch.pi
    sigmas = 10 ** (torch.rand(M, 2, generator=g, dtype=torch.float64) * 3.6 - 1.3)
    axes = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()], 1).view(M, 2, 2) * sigmas[:, None]
    means = torch.rand(M, 2, generator=g, dtype=torch.float64) * torch.tensor([width, height])
    depths, opacities = torch.rand(2, M, generator=g, dtype=torch.float64)
    return splats_from(means, axes @ axes.mT, 1 + depths, 0.05 + 0.9 * opacities, dtype)


def _composite(projected, features, width, height, background=None, tile_size=16):
    tiles = bin_tiles(projected, width, height, tile_size)
    inputs = (projected.means2d, projected.conics, projected.opacities, features)
    return numba_cpu.composite(*inputs, tiles, background)


def _gradients(projected, features, width, height):
    """All outputs and gradients under fixed cotangents."""
    leaves = [v.clone().requires_grad_() for v in (projected.means2d, projected.conics, projected.opacities, features)]
    background = torch.linspace(-1, 1, features.shape[1], dtype=features.dtype).requires_grad_()
    outputs = numba_cpu.composite(*leaves, bin_tiles(projected, width, height), background)
    g = torch.Generator().manual_seed(1)
    cotangents = [torch.randn(v.shape, generator=g, dtype=torch.float64).to(v.dtype) for v in outputs]
    return [*(v.detach() for v in outputs), *torch.autograd.grad(outputs, [*leaves, background], cotangents)]


# arithmetic -----------------------------------------------------------------------------------------------------------


@numba.njit
def _exp_all(x, out):
    for i in range(len(x)):
        out[i] = exp_negative(x[i])


@pytest.mark.parametrize(("dtype", "largest"), [(np.float32, 1e-7), (np.float64, 3e-16)])
def test_exponential_keeps_its_stated_error(dtype, largest):
    x = np.linspace(-80, 0, 200_001).astype(dtype)
    out = np.empty_like(x)
    _exp_all(x, out)
    exact = np.exp(x.astype(np.longdouble))
    assert np.abs(out / exact - 1).max() <= largest
    assert out[-1] == 1


def test_exponential_of_very_negative_numbers_is_a_normal_number():
    x = np.array([-81, -1e4, -1e30, -np.inf], np.float32)
    out = np.empty_like(x)
    _exp_all(x, out)
    np.testing.assert_allclose(out, np.exp(-80.0), rtol=1e-6)


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="reads x86-64 assembly")
def test_inner_loops_are_vectorised():
    f = np.ones(cells.CHUNK * cells.PIXELS, np.float32)
    state, run = np.ones(cells.STATE, np.float32), (0, cells.PIXELS)
    which, starts, stops = np.zeros((3, 2), np.int64)
    features, one = np.ones((1, 9), np.float32), np.float32(1)
    cells.weigh(state, f, f.copy(), 0, run, (one,) * 6)
    cells.add_colors(f, f.copy(), features, which, starts, stops, 2)
    cells.find_slopes(f, state, f.copy(), features, which, starts, stops, 2)
    cells.sum_moments(state, f, f.copy(), f.copy(), 0, run, one, one)
    cells.sum_features(np.ones((1, 15), np.float32), 6, which, f, f.copy(), which, starts, stops, 2)
    for kernel in (cells.weigh, cells.add_colors, cells.find_slopes, cells.sum_moments, cells.sum_features):
        # one assembly for each signature that was compiled so far; only the float32 ones hold packed singles
        packed = [
            len(re.findall(r"\bv?(?:mulps|fn?m(?:add|sub)\d+ps)\b", text)) for text in kernel.inspect_asm().values()
        ]
        assert max(packed) >= 4, f"{kernel.__name__} works on one pixel at a time"


# runs -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
def test_run_holds_every_touched_pixel_and_little_more(dtype):
    projected = _needles(600, 40, 40, dtype)
    features = torch.ones(600, 1, dtype=dtype)
    splats = numba_cpu._splats(projected.means2d, projected.conics, projected.opacities, features)
    values = [v.double().numpy() for v in (projected.means2d, projected.conics, projected.opacities)]
    left, top, rows = 16, 16, 13
    across = np.linspace(left + 0.5, left + cells.CELL_WIDTH - 0.5, 2001)
    touched = wasted = 0
    for row, (mean, conic, opacity) in enumerate(zip(*values, strict=True)):
        start, stop = cells.find_run(splats.ellipses, row, left, top, rows, splats.slack)
        first, last = start // cells.CELL_WIDTH, stop // cells.CELL_WIDTH - 1
        assert 0 <= start <= stop <= rows * cells.CELL_WIDTH
        for i in range(rows):
            y = top + i + 0.5
            if any(oracle.alpha_at(left + j + 0.5, y, mean, conic, opacity) for j in range(cells.CELL_WIDTH)):
                assert first <= i <= last, f"Gaussian {row}: row {i} is missing from {first}..{last}"
                touched += 1
            elif first <= i <= last:  # no pixel centre is inside: then the line through them must come near the ellipse
                dx, dy = across - mean[0], y - mean[1]
                power = conic[0] * dx * dx + 2 * conic[1] * dx * dy + conic[2] * dy * dy
                reach = 2 * np.log(255 * opacity)
                if power.min() > reach * 1.05 + 0.05:
                    wasted += 1
    assert touched > 1000
    assert wasted <= 0.05 * touched


def test_no_pixel_outside_of_the_run_is_drawn_however_it_rounds():
    """Every Gaussian has alpha on 1/255, but for rounding, at the centre of pixel (20, 20), where its tip is."""
    M = 20_000
    projected = _needles(M, 40, 40, torch.float64, seed=8)
    a, b, c = projected.conics.float().double().unbind(1)
    g = torch.Generator().manual_seed(2)
    length = 3.2 * torch.rand(M, generator=g)
    along = torch.linalg.eigh(torch.stack([a, b, b, c], dim=1).view(M, 2, 2)).eigenvectors[..., 0]
    size = (a * along[:, 0] ** 2 + 2 * b * along.prod(dim=1) + c * along[:, 1] ** 2).sqrt()
    means2d = (20.5 + along * (length / size)[:, None]).float()
    dx, dy = (20.5 - means2d.double()).unbind(1)
    opacities = torch.exp((a * dx * dx + 2 * b * dx * dy + c * dy * dy) / 2) / 255
    numbers = numba_cpu._splats(means2d, projected.conics.float(), opacities.float(), torch.ones(M, 1))
    state, weights = np.empty(cells.STATE, np.float32), np.empty(cells.CHUNK * cells.PIXELS, np.float32)
    inside = np.arange(cells.PIXELS)
    for row in range(M):
        start, stop = cells.find_run(numbers.ellipses, row, 16, 16, cells.CELL_HEIGHT, numbers.slack)
        cells.start_cell(state, 16, 16, 40, 40)
        splat = (*numbers.means2d[row], *numbers.conics[row], numbers.opacities[row])
        cells.weigh(state, weights, weights.copy(), 0, (0, cells.PIXELS), splat)
        drawn = weights[: cells.PIXELS] > 0
        assert not drawn[(inside < start) | (inside >= stop)].any(), f"Gaussian {row}"


def test_broken_gaussian_touches_nothing():
    projected, features = random_splats(20, 21, 19, seed=5)
    expected = _composite(projected, features, 21, 19)
    tiles = bin_tiles(projected, 21, 19)
    broken = torch.full((1,), float("nan"), dtype=torch.float64)
    for which in range(3):
        values = [projected.means2d, projected.conics, projected.opacities]
        extra = [torch.ones_like(v[:1]) * 0.5 for v in values]
        extra[which] = broken.expand(values[which][:1].shape)
        more = [torch.cat([v, e]) for v, e in zip(values, extra, strict=True)]
        # the broken one comes last in every tile
        lists = [
            torch.cat([tiles.rows[a:b], torch.tensor([20], dtype=torch.int32)])
            for a, b in zip(tiles.offsets[:-1], tiles.offsets[1:], strict=True)
        ]
        offsets = tiles.offsets + torch.arange(len(tiles.offsets))
        actual = numba_cpu.composite(
            *more, torch.cat([features, features[:1]]), Tiles(torch.cat(lists), offsets, 21, 19, 16), None
        )
        torch.testing.assert_close(actual, expected, rtol=0, atol=0)


# against the oracle ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("channels", [1, 3, 9, 64, 70])
def test_needles_and_blobs_agree_with_the_equations(channels, dtype):
    width, height = 37, 29
    projected = _needles(60, width, height, dtype, seed=channels)
    g = torch.Generator().manual_seed(0)
    features = torch.randn(60, channels, generator=g, dtype=torch.float64).to(dtype)
    background = torch.linspace(-1, 2, channels, dtype=dtype)
    maps, alphas = _composite(projected, features, width, height, background)
    values = (projected.means2d, projected.conics, projected.depths, projected.opacities, features, background)
    *values, background = (v.double().numpy() for v in values)
    expected = oracle.composite(*values, width, height, background)
    assert maps.dtype == alphas.dtype == dtype
    # float32: with sigma 0.05 the power's terms reach 1e5 and cancel, so that alpha carries an error of 1e5 * 6e-8
    tolerance = TOLERANCE[dtype] if dtype == torch.float64 else 2e-3
    for actual, truth in zip((maps, alphas[..., None]), expected, strict=True):
        truth = torch.from_numpy(truth).reshape(actual.shape)
        assert_close_but_for_thresholds(actual, truth, tolerance=tolerance, band=0.05)


@pytest.mark.parametrize("channels", [1, 3, 9, 64, 70])
def test_float32_follows_float64(channels):
    projected, features = random_splats(80, 45, 31, seed=channels, channels=channels, opacities=(0.2, 0.8))
    exact = _gradients(projected, features, 45, 31)
    single = projected._replace(**{n: getattr(projected, n).float() for n in projected._fields if n != "index"})
    rounded = _gradients(single, features.float(), 45, 31)
    for a, b in zip(rounded, exact, strict=True):
        # an alpha that falls on the other side of 1/255 moves a gradient by 0.004 of one pixel's
        assert (a.double() - b).abs().max() <= 2e-4 * (1 + b.abs().max())


@pytest.mark.parametrize(("tile_size", "channels"), [(16, 9), (7, 2), (20, 5)])
def test_gradcheck(tile_size, channels):
    projected, features = random_splats(10, 11, 9, seed=4, opacities=(0.2, 0.8), sigma=(1.5, 4.0), channels=channels)
    everywhere = [tile_size] * 2
    count = -(-11 // everywhere[0]) * -(-9 // everywhere[1])
    tiles = Tiles(
        torch.arange(10, dtype=torch.int32).repeat(count), torch.arange(count + 1) * 10, 11, 9, tile_size
    )  # every Gaussian in every tile
    inputs = [projected.means2d, projected.conics, projected.opacities, features, torch.randn(channels).double()]
    inputs = [v.clone().requires_grad_() for v in inputs]
    # a Gaussian is cut off at 1/255, where central differences see a step: keep the step far smaller than the density's
    assert torch.autograd.gradcheck(
        lambda *v: numba_cpu.composite(*v[:4], tiles, v[4]), inputs, eps=1e-7, atol=1e-5, rtol=1e-4
    )


@pytest.mark.parametrize("dtype", DTYPES)
def test_clamped_and_skipped_gaussians_have_no_shape_gradient(dtype):
    """Flat over the tile: the first is clamped to 0.99, the second drawn, the third too faint, the fourth stopped."""
    means2d, conics = torch.full((4, 2), 8.0, dtype=dtype), torch.tensor([[1e-13, 0, 1e-13]], dtype=dtype).repeat(4, 1)
    opacities = torch.tensor([0.995, 0.5, 0.003, 0.98999], dtype=dtype)
    features = torch.tensor([[2.0], [3.0], [5.0], [7.0]], dtype=dtype)
    tiles = Tiles(torch.arange(4, dtype=torch.int32), torch.tensor([0, 4]), 16, 16, 16)
    leaves = [v.requires_grad_() for v in (means2d, conics, opacities, features)]
    maps, alphas = numba_cpu.composite(*leaves, tiles, None)
    grads = torch.autograd.grad(maps.sum() + 10 * alphas.sum(), leaves)
    torch.testing.assert_close(grads[2][[0, 2, 3]], torch.zeros(3, dtype=dtype), rtol=0, atol=0)
    assert (grads[0][[0, 2, 3]] == 0).all()
    assert (grads[1][[0, 2, 3]] == 0).all()
    # the second: 256 pixels times T = 0.01 times (its feature + 10)
    torch.testing.assert_close(grads[2][1].item(), 256 * 0.01 * 13, rtol=1e-4, atol=0)
    expected = 256 * torch.tensor([[0.99], [0.005], [0], [0]], dtype=dtype)
    torch.testing.assert_close(grads[3], expected, rtol=1e-4, atol=0)


# threads --------------------------------------------------------------------------------------------------------------


def _many(dtype=torch.float32):
    projected, features = random_splats(700, 150, 110, seed=9, channels=9, dtype=dtype)
    return projected, features, 150, 110


@pytest.mark.parametrize("dtype", DTYPES)
def test_reruns_are_bit_equal_for_any_number_of_threads(dtype):
    threads = torch.get_num_threads()
    results = []
    try:
        for n in (1, 2, 5, 2):
            torch.set_num_threads(n)
            results.append(_gradients(*_many(dtype)))
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            assert torch.equal(a, b)


def test_may_be_called_from_several_threads_at_once():
    expected = _gradients(*_many())
    with ThreadPoolExecutor(4) as pool:
        for result in pool.map(lambda _: _gradients(*_many()), range(8)):
            for a, b in zip(result, expected, strict=True):
                assert torch.equal(a, b)


def test_bands_cover_all_tiles_once_and_do_not_depend_on_threads():
    projected, _, width, height = _many()
    grid = numba_cpu._grid(bin_tiles(projected, width, height))
    assert grid.bounds[0] == 0
    assert grid.bounds[-1] == len(grid.offsets) - 1
    assert (np.diff(grid.bounds) >= 0).all()
    assert len(grid.bounds) == numba_cpu.BANDS + 1


def test_error_of_a_band_reaches_the_caller():
    from kfgs.splat.engines.numba_threads import run_bands

    def broken(band):
        if band == 3:
            raise RuntimeError("band 3")

    with pytest.raises(RuntimeError, match="band 3"):
        run_bands(broken, 4)
