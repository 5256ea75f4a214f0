"""The numba engine beyond the contract that `test_engines.py` asks of every engine: its blocks, runs and threads."""

import json
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch
from cases_splat import random_splats
from forked import forks, in_fork

numba = pytest.importorskip("numba")

from kfgs.splat import Tiles, accumulate_pixels, bin_tiles, composite  # noqa: E402
from kfgs.splat.engines.cpu import engine as numba_cpu  # noqa: E402
from kfgs.splat.engines.cpu.square import CHUNK  # noqa: E402
from kfgs.splat.engines.cpu.threads import run_bands  # noqa: E402

DTYPES = [torch.float32, torch.float64]
every_dtype = pytest.mark.parametrize("dtype", DTYPES)


def _composite(projected, features, width, height, tile_size=16, **options):
    tiles = bin_tiles(projected, width, height, tile_size)
    inputs = (projected.means2d, projected.conics, projected.opacities, features)
    return composite(*inputs, tiles, engine="numba", **options)


def _gradients(projected, features, width, height, tiles=None, engine="numba", index=None):
    """All outputs and gradients under fixed cotangents."""
    leaves = [v.clone().requires_grad_() for v in (projected.means2d, projected.conics, projected.opacities, features)]
    background = torch.linspace(-1, 1, features.shape[1], dtype=features.dtype).requires_grad_()
    tiles = tiles or bin_tiles(projected, width, height)
    outputs = composite(*leaves, tiles, background=background, index=index, engine=engine)
    g = torch.Generator().manual_seed(1)
    cotangents = [torch.randn(v.shape, generator=g, dtype=torch.float64).to(v.dtype) for v in outputs]
    return [*(v.detach() for v in outputs), *torch.autograd.grad(outputs, [*leaves, background], cotangents)]


def _everywhere(M, width, height, tile_size):
    """Tiles that each list all Gaussians, in the order of their numbers."""
    count = -(-width // tile_size) * -(-height // tile_size)
    return Tiles(
        torch.arange(M, dtype=torch.int32).repeat(count), M * torch.arange(count + 1), width, height, tile_size
    )


@pytest.fixture
def many_bands(monkeypatch):
    """Small frames are cut into bands, too."""
    monkeypatch.setattr(numba_cpu, "PAIRS_PER_BAND", 64)


@pytest.fixture
def two_threads(many_bands):
    """Torch, and with it the engine, on two threads."""
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(threads)


# broken Gaussians -----------------------------------------------------------------------------------------------------


BROKEN = {
    "conic has NaN in a": ("conics", [float("nan"), 0.1, 0.3]),
    "conic has NaN in b": ("conics", [0.2, float("nan"), 0.3]),
    "conic has NaN in c": ("conics", [0.2, 0.1, float("nan")]),
    "conic has no bound": ("conics", [float("inf"), 0.0, float("inf")]),
    "all zero": ("conics", [0.0, 0.0, 0.0]),
    "indefinite": ("conics", [0.2, 0.5, 0.3]),
    "negative definite": ("conics", [-0.2, 0.0, -0.3]),
    "flat": ("conics", [0.0, 0.0, 0.3]),
    "x is NaN": ("means2d", [float("nan"), 8.0]),
    "y is NaN": ("means2d", [8.0, float("nan")]),
    "infinitely far": ("means2d", [float("inf"), 8.0]),
    "opacity is NaN": ("opacities", float("nan")),
    "opacity is negative": ("opacities", -0.5),
    "opacity is 0": ("opacities", 0.0),
}


@every_dtype
@pytest.mark.parametrize("channels", [3, 40])
@pytest.mark.parametrize("broken", BROKEN)
def test_a_broken_gaussian_is_not_drawn_and_changes_no_gradient(broken, channels, dtype):
    M, width, height = 20, 21, 19
    projected, features = random_splats(M + 1, width, height, seed=5, dtype=dtype, channels=channels)
    name, value = BROKEN[broken]
    values = getattr(projected, name).clone()
    values[7] = torch.tensor(value, dtype=dtype)
    projected = projected._replace(**{name: values})
    everyone = _everywhere(M + 1, width, height, 16)
    whole = everyone.rows.view(-1, M + 1)
    rows = whole[whole != 7].contiguous()  # without the broken one
    others = Tiles(rows, M * torch.arange(len(everyone.offsets)), width, height, 16)
    expected = _gradients(projected, features, width, height, others)
    actual = _gradients(projected, features, width, height, everyone)
    for i, (a, b) in enumerate(zip(actual, expected, strict=True)):
        if 2 <= i < 6:  # means2d, conics, opacities, features
            assert (a[7] == 0).all(), f"gradient {i - 2} of the broken one: {a[7]}"
            a, b = (torch.cat([v[:7], v[8:]]) for v in (a, b))
        torch.testing.assert_close(a, b, rtol=0, atol=0)


# against the oracle ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("channels", [3, 40])
def test_rising_index_is_that_of_the_selected_rows(channels, many_bands):
    """Rising numbers are worked on by many bands, others by one: the result is the same."""
    projected, features = random_splats(60, 33, 21, seed=6, channels=channels)
    index = torch.arange(60) * 2 + 1
    table = torch.full((122, channels), 7.0).double()
    table[index] = features
    plain = _gradients(projected, features, 33, 21)
    for order in (torch.arange(60), torch.arange(60).flip(0)):  # the rows of features, rising and falling
        shuffled = torch.full_like(table, 7.0)
        shuffled[index[order]] = features
        chosen = _gradients(projected, shuffled, 33, 21, index=index[order])
        gradient = chosen[5]
        chosen[5] = gradient[index[order]]
        for a, b in zip(chosen, plain, strict=True):
            torch.testing.assert_close(a, b, rtol=0, atol=0)
        assert int((gradient != 0).any(dim=1).sum()) <= 60


# long lists -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("channels", [3, 20, 40])
@pytest.mark.parametrize("count", [CHUNK - 1, CHUNK, CHUNK + 1, 3 * CHUNK + 5])
def test_lists_longer_than_a_chunk(count, channels):
    faint = {"opacities": (0.01, 0.03), "sigma": (2.0, 9.0)}
    projected, features = random_splats(count, 13, 11, seed=count, channels=channels, **faint)
    tiles = _everywhere(count, 13, 11, 16)
    ours = _gradients(projected, features, 13, 11, tiles)
    reference = _gradients(projected, features, 13, 11, tiles, engine="reference")
    assert float(ours[1].min()) > 0
    assert float(ours[1].max()) < 0.99  # no pixel stops
    for a, b in zip(ours, reference, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-9)


@pytest.mark.parametrize("channels", [3, 20, 40])
@pytest.mark.parametrize("stop", [CHUNK - 1, CHUNK, CHUNK + 1, 2 * CHUNK + 17])
def test_stop_in_the_middle_of_a_long_list(stop, channels):
    """Faint Gaussians, then one pair that is opaque everywhere but in a corner, then more that are seen there only."""
    count, width, height = 4 * CHUNK, 13, 11
    projected, features = random_splats(
        count, width, height, seed=9, opacities=(0.005, 0.02), sigma=(4.0, 9.0), channels=channels
    )
    opaque = torch.tensor([stop, stop + 1])
    means2d, conics, opacities = (getattr(projected, n).clone() for n in ("means2d", "conics", "opacities"))
    means2d[opaque], conics[opaque], opacities[opaque] = 0.0, torch.tensor([0.02, 0.0, 0.02]).double(), 5.0
    projected = projected._replace(means2d=means2d, conics=conics, opacities=opacities)
    tiles = _everywhere(count, width, height, 16)
    ours = _gradients(projected, features, width, height, tiles)
    reference = _gradients(projected, features, width, height, tiles, engine="reference")
    assert 0 < float((ours[1] > 0.99).double().mean()) < 1
    for a, b in zip(ours, reference, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-9)


def test_nothing_is_looked_at_behind_what_is_opaque():
    count, opaque = 5 * CHUNK, CHUNK + 3
    means2d, conics = torch.full((count, 2), 8.0), torch.tensor([[1e-13, 0, 1e-13]]).repeat(count, 1)
    opacities, features = torch.full((count,), 0.005), torch.full((count, 1), float("nan"))
    opacities[opaque : opaque + 3] = 0.98
    features[: 2 * CHUNK] = 1
    maps, alphas = composite(means2d, conics, opacities, features, _everywhere(count, 16, 16, 16), engine="numba")
    assert float(alphas.min()) > 0.999
    torch.testing.assert_close(maps[..., 0], alphas)  # what is behind is not even read


# threads --------------------------------------------------------------------------------------------------------------


def _many(dtype=torch.float32, channels=9):
    projected, features = random_splats(700, 150, 110, seed=9, channels=channels, dtype=dtype)
    return projected, features, 150, 110


@every_dtype
@pytest.mark.parametrize("channels", [9, 33])
def test_reruns_are_bit_equal_for_any_number_of_threads(dtype, channels, many_bands):
    threads = torch.get_num_threads()
    results = []
    try:
        for n in (1, 2, 5, 2):
            torch.set_num_threads(n)
            results.append(_gradients(*_many(dtype, channels)))
            projected, _, width, height = _many(dtype)
            pixels = torch.linspace(-1, 1, width * height * 3, dtype=dtype).view(height, width, 3)
            splats = projected.means2d, projected.conics, projected.opacities
            results[-1] += accumulate_pixels(*splats, pixels, bin_tiles(projected, width, height), engine="numba")
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            assert torch.equal(a, b)


def test_may_be_called_from_several_threads_at_once(many_bands):
    expected = _gradients(*_many())
    with ThreadPoolExecutor(4) as pool:
        for result in pool.map(lambda _: _gradients(*_many()), range(8)):
            for a, b in zip(result, expected, strict=True):
                assert torch.equal(a, b)


@pytest.mark.parametrize("channels", [3, 40])
def test_bands_change_nothing_but_rounding(channels, monkeypatch):
    results = []
    for pairs in (1 << 40, 500, 10):  # of a band at least
        monkeypatch.setattr(numba_cpu, "PAIRS_PER_BAND", pairs)
        results.append(_gradients(*_many(torch.float64, channels)))
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-11, atol=1e-11)


@every_dtype
@pytest.mark.parametrize("channels", [3, 20, 40])
def test_what_was_in_memory_before_is_never_read(channels, dtype, monkeypatch, many_bands):
    projected, features, width, height = _many(dtype, channels)
    pixels = torch.linspace(-1, 1, width * height * channels, dtype=dtype).view(height, width, channels)
    splats = projected.means2d, projected.conics, projected.opacities

    def run():
        tiles = bin_tiles(projected, width, height)
        return [
            *_gradients(projected, features, width, height, tiles),
            *accumulate_pixels(*splats, pixels, tiles, engine="numba"),
        ]

    def poisoned(like, *shape):
        return like.new_full(shape, float("nan") if like.is_floating_point() else -1)

    expected = run()
    monkeypatch.setattr(numba_cpu, "take_memory", poisoned)
    for a, b in zip(run(), expected, strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("where", [0, 3])
def test_error_of_a_band_reaches_the_caller(where, two_threads):
    def broken(band):
        time.sleep(0.005)
        if band == where:
            raise RuntimeError(f"band {where}")

    with pytest.raises(RuntimeError, match=f"band {where}"):
        run_bands(broken, 4)
    run_bands(lambda band: None, 4)  # and the threads are still there


# processes ------------------------------------------------------------------------------------------------------------


def _splats(seed=0):
    return random_splats(700, 150, 110, seed=seed, channels=9, dtype=torch.float32)


def _frame(seed=0):
    return _composite(*_splats(seed), 150, 110)[0]


@forks
def test_a_forked_child_does_all_that_its_parent_does(two_threads):
    """Multiprocessing's default on Linux until Python 3.14: torch would wait for threads that were not forked."""
    expected, left, right = _frame(), torch.rand(500, 300), torch.rand(300, 200)
    image, weight = torch.rand(1, 8, 100, 100), torch.rand(8, 8, 3, 3)
    torch.ones(1_000_000).add_(1)  # wakes torch's own threads

    def compute():
        mixed = left.clone().requires_grad_()
        (mixed @ right).square().sum().backward()
        return [left @ right, mixed.grad, torch.nn.functional.conv2d(image, weight), torch.ones(1_000_000).add_(1)]

    truth = compute()

    def work():
        same = [torch.allclose(*pair, rtol=1e-4) for pair in zip(compute(), truth, strict=True)]
        return [*same, torch.equal(_frame(), expected)]

    assert in_fork(work) == [True] * 5
    assert torch.equal(_frame(), expected)


WARM = """
import json, sys
import torch
sys.path.insert(0, {tests!r})
from cases_splat import random_splats
from kfgs.splat import Tiles, composite

projected, features = random_splats(20, 20, 16, seed=0, dtype=torch.float32)
tiles = Tiles(torch.arange(20, dtype=torch.int32).repeat(2), 20 * torch.arange(3), 20, 16, 16)
inputs = [v.requires_grad_() for v in (projected.means2d, projected.conics, projected.opacities, features)]
maps, alphas = composite(*inputs, tiles, engine="numba")
(maps.sum() + alphas.sum()).backward()

from numba.core.dispatcher import Dispatcher

modules = [module for name, module in sorted(sys.modules.items()) if name.startswith("kfgs.splat.engines.cpu.")]
kernels = {{id(v): v for module in modules for v in vars(module).values() if isinstance(v, Dispatcher)}}
print(json.dumps([
    sorted(k.__name__ for k in kernels.values() if k.overloads and k.stats.cache_hits),
    sorted(k.__name__ for k in kernels.values() if k.stats.cache_misses or k.overloads and not k.stats.cache_hits),
]))
"""


def test_a_warm_start_compiles_nothing():
    """A fresh process takes every kernel of a frame and its backward pass from the cache."""
    root = Path(__file__).parents[3]
    command = [sys.executable, "-c", WARM.format(tests=str(root / "tests"))]
    for _ in range(2):  # the first may have to fill the cache
        done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True, timeout=300)
        loaded, built = json.loads(done.stdout)
        if not built:
            break
    assert built == []
    assert {"pack_rows", "composite_band", "differentiate_band", "gather_gradients"} <= set(loaded)
