from functools import partial

import numpy as np
import oracles_splat as oracle
import pytest
import torch
from cases_splat import random_splats, splats_from
from messages import refused, tells

from kfgs.splat import Projected, accumulate_pixels, available_engines, composite
from kfgs.splat import bin_tiles as bin_tiles_by

KINDS = ["round", "needles", "huge", "subpixel", "faint"]


@pytest.fixture(params=["reference", "numba"])
def bin_tiles(request):
    """The functions of torch, and what is compiled."""
    if request.param not in available_engines():
        pytest.skip(f"engine {request.param} is not installed")
    return partial(bin_tiles_by, engine=request.param)


def _splats(kind, dtype, M=150, width=70, height=45, seed=0):
    """Gaussians of one kind, in and around an image that is no multiple of a tile."""
    if kind == "round":
        return random_splats(M, width, height, seed=seed, dtype=dtype)[0]
    if kind == "faint":  # just visible at the centre
        return random_splats(M, width, height, seed=seed, dtype=dtype, opacities=(1.0001 / 255, 1.2 / 255))[0]
    if kind == "huge":
        return random_splats(M, width, height, seed=seed, dtype=dtype, sigma=(40.0, 4000.0))[0]
    g = torch.Generator().manual_seed(seed)
    means2d = torch.rand(M, 2, generator=g).double() * torch.tensor([width, height])
    means2d[::10] = means2d[::10].round() + 0.5 * (torch.arange(len(means2d[::10]))[:, None] % 2)  # edges, centres
    depths, opacities = 1 + torch.rand(M, generator=g).double(), 0.1 + 0.89 * torch.rand(M, generator=g).double()
    angle = torch.pi * torch.rand(M, generator=g).double()
    long = 10 ** (4 * torch.rand(M, generator=g).double()) if kind == "needles" else torch.zeros(M).double()
    along = torch.stack([angle.cos(), angle.sin()], dim=1) * long[:, None]
    covs = along[:, :, None] * along[:, None, :] + 0.3 * torch.eye(2).double()  # nothing is thinner than the low pass
    return splats_from(means2d, covs, depths, opacities, dtype)


def _pairs(tiles):
    counts = tiles.offsets.diff()
    tile = torch.repeat_interleave(torch.arange(len(counts)), counts)
    return list(zip(tile.tolist(), tiles.rows.tolist(), strict=True))


def _shown(projected, width, height, tile_size):
    """(tile, Gaussian) wherever alpha reaches 1/255 at a pixel centre, by trying every pixel."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    tile = (y // tile_size).astype(int) * -(-width // tile_size) + (x // tile_size).astype(int)
    found = set()
    for g in range(len(projected.means2d)):
        mx, my = projected.means2d[g].double().tolist()
        a, b, c = projected.conics[g].double().tolist()
        power = 0.5 * (a * (x - mx) ** 2 + 2 * b * (x - mx) * (y - my) + c * (y - my) ** 2)
        shown = float(projected.opacities[g]) * np.exp(-power) >= 1 / 255
        found |= {(int(t), g) for t in np.unique(tile[shown])}
    return found


@pytest.mark.parametrize("tile_size", [16, 8])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", KINDS)
def test_no_pair_that_shows_is_missing(bin_tiles, kind, dtype, tile_size):
    projected = _splats(kind, dtype)
    found = _shown(projected, 70, 45, tile_size)
    pairs = _pairs(bin_tiles(projected, 70, 45, tile_size))
    assert len(set(pairs)) == len(pairs)
    assert found <= set(pairs)
    assert len(found) > 50


def test_rounding_loses_no_pair(bin_tiles):
    """Gaussians that show at the corner pixel of the tile by one float32 rounding step, and nowhere else."""
    g = torch.Generator().manual_seed(0)
    M = 2000
    dx, dy = 1 + 300 * torch.rand(M, generator=g), 1 + 300 * torch.rand(M, generator=g)  # the corner, from the mean
    means2d = 0.5 - torch.stack([dx, dy], dim=1)
    dx, dy = (0.5 - means2d).unbind(1)
    share = torch.rand(M, generator=g)
    a, c = 8 * share / dx**2, 8 * (1 - share) / dy**2
    b = 0.5 * torch.rand(M, generator=g) * (a * c).sqrt()  # positive: the form grows away from the corner
    a, b, c = (v * 8 / (a * dx**2 + 2 * b * dx * dy + c * dy**2) for v in (a, b, c))
    density = torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    opacities = 1 / (255 * density)
    while (faint := opacities * density < 1 / 255).any():
        opacities = torch.where(faint, opacities * (1 + 1e-7), opacities)
    extents = torch.full((M, 2), 1e3)
    projected = Projected(means2d, torch.stack([a, b, c], dim=1), torch.ones(M), opacities, extents, torch.arange(M))
    assert bin_tiles(projected, 16, 16).rows.tolist() == list(range(M))
    assert len(bin_tiles(projected._replace(opacities=0.99 * opacities), 16, 16).rows) == 0


@pytest.mark.parametrize("kind", KINDS)
def test_listed_pairs_reach_the_tile(bin_tiles, kind):
    projected = _splats(kind, torch.float64)
    pairs = _pairs(bin_tiles(projected, 70, 45))
    for tile, g in pairs:
        top, left = 16 * (tile // 5) + 0.5, 16 * (tile % 5) + 0.5
        mx, my = projected.means2d[g].tolist()
        smallest = oracle.smallest_in_rectangle(
            projected.conics[g].tolist(), left - mx, left + 15 - mx, top - my, top + 15 - my
        )
        assert smallest <= oracle.reach(float(projected.opacities[g])) + 1e-6


def test_tiles_are_numbered_along_image_rows(bin_tiles):
    one = torch.ones(3).double()
    means2d = torch.tensor([[8.0, 8.0], [40.0, 8.0], [8.0, 24.0]]).double()
    covs = torch.eye(2).double().repeat(3, 1, 1)
    tiles = bin_tiles(splats_from(means2d, covs, one, 0.5 * one, torch.float32), 48, 32)
    assert tiles.offsets.tolist() == [0, 1, 1, 2, 3, 3, 3]
    assert tiles.rows.tolist() == [0, 1, 2]
    assert (tiles.rows.dtype, tiles.offsets.dtype) == (torch.int32, torch.int64)
    assert tiles.grid == (2, 3)


def test_no_gradient_is_recorded(bin_tiles):
    projected = _splats("round", torch.float32)
    projected = projected._replace(means2d=projected.means2d.requires_grad_())
    assert not bin_tiles(projected, 70, 45).rows.requires_grad


def test_shapes_must_agree(bin_tiles):
    projected = _splats("round", torch.float32)._replace(depths=torch.ones(3))
    refused(lambda: bin_tiles(projected, 70, 45), "projected.depths:", "[M]", "M = 150", "got (3,)")


@pytest.mark.parametrize("engine", ["auto", "numba"])
def test_mixed_dtypes_are_binned_by_torch(engine):
    projected = _splats("round", torch.float32)
    mixed = projected._replace(depths=projected.depths.double())
    assert torch.equal(bin_tiles_by(mixed, 70, 45, engine=engine).rows, bin_tiles_by(projected, 70, 45).rows)


SIZES = {"width": 70, "height": 45, "tile_size": 16}


@pytest.mark.parametrize(("name", "size"), [("width", 33.5), ("height", 45.0), ("tile_size", 0)])
def test_sizes_are_whole_numbers_with_every_engine(bin_tiles, name, size):
    engine, splats = bin_tiles.keywords["engine"], _splats("round", torch.float32)
    refused(lambda: bin_tiles(splats, **(SIZES | {name: size})), f"{name}:", f"got {size}")
    tiles = bin_tiles(splats, **SIZES)._replace(**{name: size})
    footprints = splats.means2d, splats.conics, splats.opacities
    with pytest.raises(ValueError, match=tells(f"tiles.{name}:", f"got {size}")):
        composite(*footprints, torch.rand(len(splats.means2d), 2), tiles, engine=engine)
    with pytest.raises(ValueError, match=tells(f"tiles.{name}:", f"got {size}")):
        accumulate_pixels(*footprints, torch.rand(45, 70, 2), tiles, engine=engine)
