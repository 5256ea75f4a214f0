"""Ranking channels while compositing: the same labels as the arg-max over the maps, which is the slow path here."""

import pytest
import torch
from cases_splat import a_camera, gaussians_before, random_splats
from messages import refused, tells

from kfgs.splat import Tiles, available_engines, bin_tiles, composite, rasterize, rasterize_labels
from kfgs.splat.engines import rank_channels

ENGINES = [name for name in available_engines("cpu") if name != "triton"]
DTYPES = [torch.float32, torch.float64]
every_engine = pytest.mark.parametrize("engine", ENGINES)
compiled = pytest.mark.skipif("numba" not in ENGINES, reason="only a compiled engine leaves pixels early")


def ordered(maps, alphas, top):
    """The largest channels, of equal ones the lowest first; -1 and 0 where nothing was drawn."""
    scores, labels = maps.sort(dim=-1, descending=True, stable=True)
    empty = (alphas <= 0)[..., None]
    return labels[..., :top].masked_fill(empty, -1), scores[..., :top].masked_fill(empty, 0)


def scene(channels, size=(24, 18), count=40, dtype=torch.float32, tile_size=16, rounded=False, **options):
    projected, features = random_splats(count, *size, seed=3, dtype=dtype, channels=channels, **options)
    features = features.round() if rounded else features
    footprints = projected.means2d, projected.conics, projected.opacities
    return footprints, features, bin_tiles(projected, *size, tile_size)


def assert_ranked(footprints, features, tiles, engine, top, index=None):
    found = rank_channels(*footprints, features, tiles, top=top, index=index, engine=engine)
    maps, alphas = composite(*footprints, features, tiles, index=index, engine=engine)
    labels, scores = ordered(maps, alphas, top)
    assert found.labels.dtype == torch.int64
    assert found.labels.equal(labels)
    assert found.scores.equal(scores)  # to the bit
    assert found.alphas.equal(alphas)
    return found


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("channels", [1, 4, 5, 10, 11, 26, 27, 150])
@every_engine
def test_labels_are_those_of_the_maps_to_the_bit(engine, channels, dtype):
    case = scene(channels, dtype=dtype)
    for top in sorted({1, min(3, channels)}):
        assert_ranked(*case, engine, top)


@pytest.mark.parametrize("size", [(1, 1), (3, 2), (17, 5), (33, 16), (50, 47)])
@pytest.mark.parametrize("tile_size", [5, 16, 32])
@pytest.mark.parametrize("channels", [3, 40])
@every_engine
def test_small_and_odd_pictures(engine, channels, tile_size, size):
    assert_ranked(*scene(channels, size=size, tile_size=tile_size), engine, 2)


@pytest.mark.parametrize("channels", [3, 20, 40])
@every_engine
def test_a_tie_goes_to_the_lowest_class(engine, channels):
    """Whole numbers: many classes have the same sums. And all classes may be equal."""
    footprints, features, tiles = scene(channels, rounded=True)
    assert_ranked(footprints, features, tiles, engine, channels)
    same = assert_ranked(footprints, torch.ones_like(features), tiles, engine, channels)
    drawn = same.alphas > 0
    assert same.labels[drawn].equal(torch.arange(channels).expand(int(drawn.sum()), -1))


@pytest.mark.parametrize("channels", [3, 40])
@every_engine
def test_where_nothing_is_drawn(engine, channels):
    found = assert_ranked(*scene(channels, size=(100, 40), count=3, sigma=(0.7, 2.0)), engine, 2)
    empty = found.alphas == 0
    assert 0.5 < empty.float().mean() < 1
    assert (found.labels[empty] == -1).all()
    assert (found.scores[empty] == 0).all()
    nobody = assert_ranked(*scene(channels, count=0), engine, 1)
    assert (nobody.labels == -1).all()


def votes(features, sharpness):
    return torch.softmax(sharpness * features, dim=1).contiguous()


def assert_early(footprints, features, tiles):
    """The labels are the same, also of pixels that were left early; how many of the covered pixels were."""
    whole, early = (rank_channels(*footprints, features, tiles, engine="numba", early=early) for early in (False, True))
    assert early.labels.equal(whole.labels)
    assert early.alphas.le(whole.alphas).all()
    if (features >= 0).all():
        assert early.scores.gt(0).equal(whole.scores.gt(0))
    left = early.alphas < whole.alphas
    return float(left.float().mean())


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("sharpness", [0.1, 3.0, 100.0])
@pytest.mark.parametrize("channels", [1, 2, 4, 5, 18, 26, 40])
@compiled
def test_labels_alone_are_the_same(channels, sharpness, dtype):
    """Votes that hardly differ, and votes for one class alone: few and many channels may win in a tile."""
    footprints, features, tiles = scene(channels, size=(70, 50), count=800, dtype=dtype)
    assert_early(footprints, votes(features, sharpness), tiles)


@pytest.mark.parametrize("classes", [1, 3, 7])
@compiled
def test_pixels_are_left_where_the_label_is_certain(classes):
    footprints, features, tiles = scene(18, size=(70, 50), count=800)
    some = torch.nn.functional.one_hot(torch.arange(len(features)) % classes, 18).to(features)
    assert assert_early(footprints, some, tiles) > 0.5


@compiled
def test_gaussians_without_votes_decide_nothing():
    """In front of the others they take light, so that pixels of the others are decided later, or never seen."""
    footprints, features, tiles = scene(6, size=(70, 50), count=800)
    some = votes(features, 10.0) * (torch.arange(800) % 3 == 0)[:, None]
    assert_early(footprints, some.contiguous(), tiles)
    assert_early(footprints, torch.zeros_like(some), tiles)


@compiled
def test_ties_are_never_certain():
    footprints, features, tiles = scene(5, size=(70, 50), count=800)
    halves = torch.tensor([[0.0, 0.5, 0.0, 0.5, 0.0]]).expand_as(features).contiguous()
    assert_early(footprints, halves, tiles)
    assert_early(footprints, (0.5 * features.round()).abs(), tiles)
    assert_early(footprints, features - 0.5, tiles)  # negative ones among them


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("offset", "spread"), [(1.0, 1e-6), (10.0, 1e-4), (1000.0, 1e-3), (0.0, 1e-44)])
@compiled
def test_rounding_may_decide_scores_that_hardly_differ(offset, spread, dtype):
    """The last digit of a sum is then as large as a lead, and the label is that of the rounded sums."""
    footprints, features, tiles = scene(7, size=(70, 50), count=2000, dtype=dtype)
    for seed in range(3):
        g = torch.Generator().manual_seed(seed)
        share = torch.rand(features.shape, generator=g, dtype=dtype)
        assert_early(footprints, offset + spread * share, tiles)


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
@compiled
def test_a_score_that_is_no_number_is_not_overlooked(value):
    footprints, features, tiles = scene(5, size=(70, 50), count=800)
    some = votes(features, 10.0)
    some[::50, 2] = value
    assert_early(footprints, some, tiles)


@pytest.mark.parametrize("channels", [3, 30])
@every_engine
def test_an_index_with_gaps_in_memory(engine, channels):
    footprints, features, tiles = scene(channels)
    index = (torch.arange(80) % 7)[::2]
    found = assert_ranked(footprints, features[:9].contiguous(), tiles, engine, 2, index)
    same = rank_channels(*footprints, features[index].contiguous(), tiles, top=2, engine=engine)
    assert found.labels.equal(same.labels)
    assert found.scores.equal(same.scores)


def test_threads_and_repetition_change_nothing():
    camera = a_camera(320, 200, focal=(200.0, 190.0), principal=(150.0, 90.0), dtype=torch.float32)
    gaussians = gaussians_before(camera, 3000, seed=1, channels=18)
    threads = torch.get_num_threads()
    found = []
    try:
        for number in (1, 2, 2):
            torch.set_num_threads(number)
            found.append(rasterize_labels(gaussians, camera, top=2))
    finally:
        torch.set_num_threads(threads)
    for other in found[1:]:
        assert all(one.equal(two) for one, two in zip(found[0], other, strict=True))


@every_engine
def test_from_gaussians_and_a_camera(engine):
    camera = a_camera(dtype=torch.float32)
    gaussians = gaussians_before(camera, 60, seed=5, channels=9)
    gaussians.features.requires_grad_()
    found, seen = rasterize_labels(gaussians, camera, top=4, engine=engine), rasterize(gaussians, camera, engine=engine)
    labels, scores = ordered(seen.map, seen.alpha, 4)
    assert found.labels.equal(labels)
    assert found.scores.equal(scores)
    assert not found.scores.requires_grad
    near = rasterize_labels(gaussians, camera, engine=engine, near=5.0)
    assert near.alphas.equal(rasterize(gaussians, camera, engine=engine, near=5.0).alpha)


@pytest.mark.parametrize("top", [0, 6, 1.5])
def test_top_out_of_range(top):
    footprints, features, tiles = scene(5)
    with pytest.raises((ValueError, TypeError), match=tells("top:", "5" if top == 6 else "")):
        rank_channels(*footprints, features, tiles, top=top)


def test_what_does_not_fit_is_refused():
    footprints, features, tiles = scene(5)
    refused(lambda: rank_channels(*footprints, features[:3], tiles), "features", "[M, D]")
    with pytest.raises(ValueError, match=tells("tiles.rows:", "40", "bin the tiles again")):
        rank_channels(*footprints, features, Tiles(tiles.rows + 40, *tiles[1:]))
    camera = a_camera(dtype=torch.float32)
    gaussians = gaussians_before(camera, 3, seed=5)
    with pytest.raises(ValueError, match=tells("gaussians:", "scores", "got None", "replace")):
        rasterize_labels(gaussians.replace(features=None, sh=torch.zeros(3, 1, 3)), camera)
