"""The compiled binning against the functions of torch, which it equals to the bit, and against every pixel centre."""

import numpy as np
import pytest
import torch
from cases_splat import splats_from

from kfgs.splat import bin_tiles

numba = pytest.importorskip("numba")

from kfgs.splat.engines.cpu import tiles as numba_tiles  # noqa: E402

DTYPES = [torch.float32, torch.float64]
NAN, INF = float("nan"), float("inf")


def _splats(seed, dtype, M=80, width=90, height=60):
    """Gaussians of every shape, from far below a pixel to far beyond the picture, in and around it; some equally deep."""
    g = np.random.default_rng(seed)
    means = torch.from_numpy(g.uniform(-0.2, 1.2, (M, 2)) * [width, height])
    means[::7] = means[::7].round() + torch.from_numpy(g.choice([0.0, 0.5], (len(means[::7]), 1)))  # on edges, centres
    angle = torch.from_numpy(g.uniform(0, np.pi, M))
    sigmas = torch.from_numpy(10 ** g.uniform(-2, 1.2, (M, 2)))
    sigmas[::3, 0] = torch.from_numpy(10 ** g.uniform(0, 4, len(sigmas[::3])))  # needles, and some huge
    sigmas[::15, 1] = sigmas[::15, 0]
    axes = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()], 1).view(M, 2, 2) * sigmas[:, None]
    axes[::5] = torch.diag_embed(sigmas[::5])  # along the axes
    opacities = torch.from_numpy(np.where(g.random(M) < 0.2, g.uniform(1, 1.3, M) / 255, g.uniform(0.01, 1, M)))
    depths = torch.from_numpy(g.choice([*g.uniform(0.2, 10, 20), 1.0], M))
    return splats_from(means, axes @ axes.mT + 0.3 * torch.eye(2), depths, opacities, dtype)


def _same(projected, width, height, tile_size):
    expected = bin_tiles(projected, width, height, tile_size, engine="reference")
    actual = bin_tiles(projected, width, height, tile_size, engine="numba")
    assert (actual.rows.dtype, actual.offsets.dtype) == (torch.int32, torch.int64)
    return torch.equal(actual.rows, expected.rows) and torch.equal(actual.offsets, expected.offsets)


@pytest.mark.parametrize("tile_size", [1, 5, 8, 16, 32, 100])
@pytest.mark.parametrize("dtype", DTYPES)
def test_lists_are_those_of_torch_to_the_bit(dtype, tile_size):
    for seed in range(60 if tile_size > 1 else 5):
        g = np.random.default_rng(seed)
        width, height = (int(n) for n in g.integers(1, 200, 2))
        assert _same(_splats(seed, dtype, 80, width, height), width, height, tile_size), f"seed {seed}"


@pytest.mark.parametrize("M", [1, 63, 64, 65, 5000])
def test_any_number_of_gaussians_fills_the_blocks(M):
    assert _same(_splats(M, torch.float32, M), 90, 60, 16)


@pytest.mark.parametrize("dtype", DTYPES)
def test_threads_and_shares_do_not_matter(dtype, monkeypatch):
    projected, threads = _splats(1, dtype, 700), torch.get_num_threads()
    before = bin_tiles(projected, 90, 60, engine="reference")
    try:
        for share in (1, 50, 64, 300, 8192):
            monkeypatch.setattr(numba_tiles, "_SHARE", share)
            for count in (1, 2, 5):
                torch.set_num_threads(count)
                after = bin_tiles(projected, 90, 60, engine="numba")
                assert torch.equal(after.rows, before.rows)
                assert torch.equal(after.offsets, before.offsets)
    finally:
        torch.set_num_threads(threads)


@pytest.mark.parametrize("dtype", DTYPES)
def test_malformed_gaussians_are_as_harmless_as_in_torch(dtype):
    odd = torch.tensor([NAN, INF, -INF, 0.0, -1.0, 1e30, -1e30, 1e-30], dtype=dtype)
    for seed in range(60):
        projected = [v.clone() for v in _splats(seed, dtype)]
        g = torch.Generator().manual_seed(seed)
        for value in projected[:5]:
            flat = value.view(-1)
            where = torch.randint(len(flat), (12,), generator=g)
            flat[where] = odd[torch.randint(len(odd), (12,), generator=g)]
        tiles = bin_tiles(type(_splats(0, dtype))(*projected), 90, 60, engine="numba")
        assert int(tiles.offsets[-1]) == len(tiles.rows)
        assert (tiles.offsets.diff() >= 0).all()
        assert ((tiles.rows >= 0) & (tiles.rows < 80)).all()
        assert _same(type(_splats(0, dtype))(*projected), 90, 60, 16), f"seed {seed}"
