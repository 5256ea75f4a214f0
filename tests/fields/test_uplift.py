from dataclasses import replace
from functools import partial

import cases_clouds
import numpy as np
import oracles_answers
import oracles_uplift
import pytest
import torch
from cases_quant import first_channels
from cases_splat import a_camera, gaussians_before
from messages import refused
from oracles_color import block_means
from torch.utils._python_dispatch import TorchDispatchMode

from kfgs import Camera, Gaussians
from kfgs._rows import unit_rows
from kfgs.cameras import resize_map
from kfgs.fields import Autoencoded, Codewords, Identity, SemanticField, UpliftConfig, fuse_views, uplift, uplift_maps
from kfgs.fields.working_maps import WorkingMaps, shrink_camera, shrink_map
from kfgs.quant import Codebook
from kfgs.splat import average_views, rasterize

PLAIN = UpliftConfig(corrections=0, keep=1.0)  # the average alone, and as many latents as channels


def cameras(n=4, width=13, height=10):
    """Views from beside each other."""
    base = a_camera(width, height, focal=(14.0, 12.0), principal=(5.3, 5.6))
    moved = []
    for i in range(n):
        viewmat = base.viewmat.clone()
        viewmat[:2, 3] += torch.tensor([0.3 * i, -0.2 * i])
        moved.append(replace(base, viewmat=viewmat, name=f"view {i}"))
    return moved


def cloud(n=12, seed=0):
    return gaussians_before(cameras()[0], n, seed=seed, depth=(2.0, 6.0), spread=0.9).replace(features=None)


def random_maps(views, channels=5, size=None, seed=0):
    g = torch.Generator().manual_seed(seed)
    return [torch.randn(*(size or view.size), channels, generator=g) for view in views]


def ahead(n=1, size=8):
    """A camera at the origin that looks along z, seen n times."""
    K = torch.tensor([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1.0]])
    return [Camera(torch.eye(4), K, size, size, f"view {i}") for i in range(n)]


balls = partial(cases_clouds.balls, scale=0.15)


def blend_weights(gaussians, views):
    """The share of each pixel that each Gaussian fills, by the slow oracle."""
    numbers = [x.double().numpy() for x in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)]
    return [
        oracles_uplift.blend_weights(*numbers, c.viewmat.double().numpy(), c.K.double().numpy(), c.width, c.height)
        for c in views
    ]


def decoded(uplifted):
    return uplifted.decoder.decode(uplifted.gaussians.features)


# Against the equations


@pytest.mark.parametrize("corrections", [0, 1, 2])
def test_features_are_those_of_the_slow_oracle(monkeypatch, corrections):
    monkeypatch.setattr(uplift, "NEIGHBOURS", 4)
    views, gaussians = cameras(), cloud()
    maps = random_maps(views)
    smooth = torch.randn(5, generator=torch.Generator().manual_seed(1))
    maps = [0.5 * features + smooth for features in maps]
    maps[1][3:5, 2:9] = 0  # nothing is known there
    weights, places = blend_weights(gaussians, views), gaussians.means.numpy()
    expected, pixels = oracles_uplift.uplift(weights, [m.double().numpy() for m in maps], places, corrections, 4)
    found = uplift_maps(gaussians, views, maps, UpliftConfig(corrections=corrections, keep=1.0))
    assert (pixels > 1).sum() >= 8
    np.testing.assert_allclose(decoded(found).numpy(), expected, atol=1e-5)


def test_without_corrections_it_is_the_average_of_unit_features_which_count_less_near_a_border():
    views, gaussians = cameras(), cloud()
    maps = random_maps(views, size=(5, 6))  # smaller than the pictures: rendered at once the size
    small = [view.resized(10, 12) for view in views]
    trust = torch.from_numpy(oracles_uplift.trust(10, 12))
    resized = (torch.cat([resize_map(unit_rows(m), (10, 12)), torch.ones(10, 12, 1)], -1) * trust for m in maps)
    average = average_views(gaussians, zip(small, resized, strict=True)).values
    found = uplift_maps(gaussians, views, maps, PLAIN)
    torch.testing.assert_close(decoded(found), average[:, :-1] / average[:, -1:], atol=1e-5, rtol=0)


def test_latents_are_chosen_by_directions_and_pixels():
    """Three balls, each before a feature of its own. The second one's views agree only on 0.6 of e1, but it has more pixels
    than the third, so that e0 and e1 are the two latents to keep."""
    gaussians = balls([[-0.7, 0.0, 2.0], [0.0, 0.0, 2.0], [0.7, 0.0, 2.0]])
    gaussians = gaussians.replace(scales=torch.tensor([[0.1], [0.08], [0.05]]).expand(3, 3))
    maps = [torch.zeros(24, 24, 4) for _ in range(2)]
    for features, sign in zip(maps, (1, -1), strict=True):
        features[:, :8, 0] = 1
        features[:, 8:16] = torch.tensor([0.0, 0.6, 0.8 * sign, 0.0])
        features[:, 16:, 3] = 1
    found = uplift_maps(gaussians, ahead(2, size=24), maps, replace(PLAIN, max_latents=2))
    expected = torch.tensor([[1.0, 0, 0, 0], [0, 0.6, 0, 0], [0, 0, 0, 0]])
    torch.testing.assert_close(decoded(found), expected, atol=1e-5, rtol=0)


# Laws


@pytest.mark.parametrize("corrections", [0, 1, 3])
def test_uniform_maps_give_their_feature_to_every_gaussian_that_is_shown(corrections):
    views, gaussians = cameras(), cloud()
    feature = torch.tensor([2.0, 0, -1, 2, 0])
    maps, config = [feature.expand(*v.size, 5) for v in views], UpliftConfig(corrections=corrections)
    found = uplift_maps(gaussians, views, maps, config)
    shown = found.known
    assert shown.sum() >= 8
    assert found.decoder.latent == 1
    expected = (feature / 3).double() * shown[:, None]
    torch.testing.assert_close(decoded(found), expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("config", [PLAIN, UpliftConfig(max_gaussians=5)])
def test_only_the_directions_of_features_count(config):
    views, gaussians = cameras(), cloud()
    maps = random_maps(views)
    factors = [4 * torch.rand(*view.size, 1, generator=torch.Generator().manual_seed(7)) + 0.01 for view in views]
    one = uplift_maps(gaussians, views, maps, config)
    other = uplift_maps(gaussians, views, [m * f for m, f in zip(maps, factors, strict=True)], config)
    torch.testing.assert_close(decoded(other), decoded(one), atol=1e-5, rtol=0)


def test_all_zero_pixels_are_holes():
    """The left ball stands before unknown pixels alone, the right one before both; they change nothing of it."""
    gaussians = balls([[-0.7, 0.0, 2.0], [0.1, 0.0, 2.0]])
    holes = torch.zeros(8, 8, 2)
    holes[:, 4:] = torch.tensor([0.0, 3.0])
    found = uplift_maps(gaussians, ahead(), [holes], PLAIN)
    torch.testing.assert_close(decoded(found), torch.tensor([[0.0, 0], [0, 1]]))


@pytest.mark.parametrize("corrections", [0, 1])
def test_what_no_view_shows_knows_nothing(corrections):
    gaussians = balls([[0.0, 0.0, 2.0], [0.0, 0.0, -2.0], [50.0, 0.0, 2.0], [0.2, 0.0, 2.5]])
    found = uplift_maps(gaussians, ahead(3), random_maps(ahead(3)), UpliftConfig(corrections=corrections))
    assert found.known.tolist() == [True, False, False, True]


# Corrections


def row_of_balls(n=24):
    """Two rows of small balls close together: every pixel blends some. Their features change from ball to ball."""
    g = torch.Generator().manual_seed(0)
    means = torch.stack([torch.linspace(-1.5, 1.5, n), torch.arange(n) % 2 * 0.2 - 0.1, torch.full((n,), 3.0)], dim=1)
    truth = torch.nn.functional.normalize(torch.randn(4, 6, generator=g)[torch.arange(n) // 6], dim=1)
    return balls(means, scale=0.12, opacity=0.8), truth


def side_views(n=8, size=32):
    views = []
    for i in range(n):
        viewmat = torch.eye(4)
        viewmat[:2, 3] = torch.tensor([0.05 * (i - n / 2), 0.03 * (i % 3)])
        K = torch.tensor([[28.0, 0, size / 2], [0, 28.0, size / 2], [0, 0, 1]])
        views.append(Camera(viewmat, K, size, size))
    return views


def wrongness(uplifted, truth):
    """1 - cosine with the true features, on average over the Gaussians."""
    return float((1 - torch.nn.functional.cosine_similarity(decoded(uplifted), truth, dim=1)).mean())


def test_a_correction_takes_out_what_blurred_maps_mixed_in():
    gaussians, truth = row_of_balls()
    views = side_views()
    maps = [shrink_map(rasterize(gaussians.replace(features=truth), view).map, 2) for view in views]
    configs = [UpliftConfig(corrections=k, keep=1.0) for k in (0, 1, 2)]
    errors = [wrongness(uplift_maps(gaussians, views, maps, config), truth) for config in configs]
    assert errors[0] > 0.02  # or there is nothing to correct
    assert errors[1] < 0.8 * errors[0]
    assert errors[2] < errors[1]


def test_a_correction_does_not_follow_noise(monkeypatch):
    """Every pixel of every view is wrong in a way of its own. A correction that is believed follows it."""
    gaussians, views = row_of_balls()[0], side_views()
    truth = torch.eye(6)[:1].expand(24, 6)
    g = torch.Generator().manual_seed(0)
    maps = [truth[0] + 1.5 * torch.randn(32, 32, 6, generator=g) for _ in views]
    configs = [UpliftConfig(corrections=k, keep=1.0) for k in (0, 1)]
    errors = [wrongness(uplift_maps(gaussians, views, maps, config), truth) for config in configs]
    monkeypatch.setattr(uplift, "reliability", lambda one, other, near: torch.ones(len(one)))
    believed = wrongness(uplift_maps(gaussians, views, maps, configs[1]), truth)
    assert errors[1] < 1.1 * errors[0]
    assert believed > 1.5 * errors[0]


# Sizes


@pytest.mark.parametrize(("height", "width"), [(20, 24), (21, 25)], ids=["whole", "with a row and a column left over"])
def test_large_maps_are_shrunk_to_the_working_size(height, width):
    """Maps of equal 2 x 2 blocks shrink to maps of a pixel each, without loss. What is left over changes nothing."""
    views, gaussians = cameras(width=width, height=height), cloud()
    small = [unit_rows(m) for m in random_maps(views, size=(10, 12))]
    large = [torch.ones(height, width, 5) for _ in views]
    for whole, m in zip(large, small, strict=True):
        whole[:20, :24] = m.repeat_interleave(2, dim=0).repeat_interleave(2, dim=1)
    config = UpliftConfig(corrections=1, keep=1.0, pixels=130)
    cut = [replace(view, width=24, height=20) for view in views]
    one, other = uplift_maps(gaussians, cut, small, config), uplift_maps(gaussians, views, large, config)
    torch.testing.assert_close(decoded(one), decoded(other), atol=1e-5, rtol=0)


class Maps(list):
    """Maps that note which of them are read; `dies` stops the process at the third, once."""

    def __init__(self, maps, dies=False):
        super().__init__(maps)
        self.reads, self.dies = [], dies

    def __getitem__(self, i):
        if i == 2 and self.dies:
            self.dies = False
            raise KeyboardInterrupt
        self.reads.append(i)
        return super().__getitem__(i)


class Grid(Maps):
    def grid(self, i, samples):
        return list.__getitem__(self, i).reshape(-1, 5)[:samples]


def test_maps_are_read_twice_and_sampled_by_their_own_grid_where_they_have_one():
    config = UpliftConfig(corrections=2, max_gaussians=5)
    plain, grid = Maps(random_maps(cameras())), Grid(random_maps(cameras()))
    one, other = (uplift_maps(cloud(), cameras(), maps, config) for maps in (plain, grid))
    assert plain.reads == [0, 1, 2, 3, 0, 1, 2, 3]
    assert grid.reads == [0, 1, 2, 3]
    torch.testing.assert_close(decoded(one), decoded(other), atol=1e-5, rtol=0)


def test_no_table_of_gaussians_by_channels_is_made():
    """Counted over every tensor that torch makes: none has 301 Gaussians (or more) and 211 channels."""

    class Shapes(TorchDispatchMode):
        def __init__(self):
            super().__init__()
            self.seen = set()

        def __torch_dispatch__(self, function, types, args=(), kwargs=None):
            result = function(*args, **(kwargs or {}))
            for value in result if isinstance(result, tuple | list) else (result,):
                if isinstance(value, torch.Tensor):
                    self.seen.add(tuple(value.shape))
            return result

    gaussians = cloud(301)
    with Shapes() as shapes:
        uplift_maps(gaussians, cameras(), random_maps(cameras(), channels=211), UpliftConfig(max_gaussians=100))
    assert (2, 301, 65) in shapes.seen  # or nothing was recorded
    assert not [shape for shape in shapes.seen if 211 in shape and any(size >= 301 for size in shape)]


# Merging


def test_merging_leaves_at_most_what_was_asked_for():
    found = uplift_maps(cloud(200), cameras(), random_maps(cameras(), channels=8), UpliftConfig(max_gaussians=40))
    assert 20 < len(found.gaussians) <= 40


def test_merged_features_are_means_by_pixels():
    """Two balls in one place become one: half of the pixels say x, half say y."""
    gaussians = balls([[-0.5, 0.0, 2.0], [0.5, 0.0, 2.0]])
    signal = torch.zeros(8, 8, 2)
    signal[:, :4, 0], signal[:, 4:, 1] = 1, 1
    found = uplift_maps(gaussians, ahead(), [signal], replace(PLAIN, max_gaussians=1))
    assert len(found.gaussians) == 1
    torch.testing.assert_close(decoded(found), torch.tensor([[0.5, 0.5]]), atol=1e-4, rtol=0)


# The files of the maps


def test_a_killed_uplift_reads_no_map_twice_and_gives_the_same_bits(tmp_path):
    maps = Grid(random_maps(cameras()), dies=True)
    with pytest.raises(KeyboardInterrupt):
        uplift_maps(cloud(), cameras(), maps, scratch=tmp_path)
    assert maps.reads == [0, 1]
    resumed, whole = (
        uplift_maps(cloud(), cameras(), maps, scratch=tmp_path),
        uplift_maps(cloud(), cameras(), list(maps)),
    )
    assert maps.reads == [0, 1, 2, 3]
    assert torch.equal(resumed.gaussians.features, whole.gaussians.features)
    assert torch.equal(resumed.decoder.basis, whole.decoder.basis)


def test_gaussians_that_fill_little_of_the_views_are_pointed_out():
    small = cloud()
    assert "note" not in uplift_maps(small, cameras(), random_maps(cameras())).info
    one = small.select(torch.arange(1)).replace(scales=torch.full((1, 3), 0.01))
    found = uplift_maps(one, cameras(), random_maps(cameras()))
    assert "of the views; are they in the cameras' frame?" in found.info["note"]


def test_a_field_says_how_much_of_other_views_it_explains():
    """Where nothing is drawn, nothing is explained. Two views that contradict each other explain themselves alone."""
    (gaussians, truth), views = row_of_balls(), side_views()
    agreeing = [rasterize(gaussians.replace(features=truth), view).map for view in views]
    left_out, own = uplift_maps(gaussians, views, agreeing).info["explained"]
    assert 0.4 < left_out == pytest.approx(own, abs=1e-3)
    left_out, own = uplift_maps(gaussians, views[:2], [agreeing[0], agreeing[1].roll(3, dims=2)]).info["explained"]
    assert left_out == 0 < 0.4 < own


# What the views show of a trained field

DIM = 6


def codebook():
    """Four directions, not orthogonal, of unequal lengths."""
    rows = torch.eye(4, DIM) * torch.tensor([2.0, 3.0, 1.0, 1.5])[:, None]
    rows[1, 0], rows[3, 5] = 1.0, -1.0
    return Codebook(rows)


def fuse(cloud, mode, cameras):
    book = Codewords(codebook()) if mode == "adc" else Autoencoded(codebook(), first_channels(4, DIM))
    field = SemanticField(cloud, Identity(DIM) if mode == "decouple" else book)
    return fuse_views(field, cameras).fused


def views():
    return [camera.to(torch.float32) for camera in cameras(3)]


def trained(mode, n=10):
    """Gaussians whose latents are those of codewords, with noise; the last two stand far outside of every view."""
    g = torch.Generator().manual_seed(0)
    cloud = gaussians_before(views()[0], n, seed=2, depth=(2.0, 6.0), spread=0.8, opacities=(0.5, 0.9))
    means = cloud.means.clone()
    means[-2:] += 1000
    features = codebook().unit[torch.arange(n) % 4]
    if mode == "adc+sc":
        features = first_channels(4, DIM).encode(codebook().codewords)[torch.arange(n) % 4]
    return cloud.replace(means=means, features=features + 0.1 * torch.randn(features.shape, generator=g))


@pytest.mark.parametrize("mode", ["decouple", "adc", "adc+sc"])
def test_answers_are_those_of_the_slow_oracle(mode):
    cloud, book = trained(mode), None if mode == "decouple" else codebook()
    coder = first_channels(4, DIM) if mode == "adc+sc" else None
    codewords = codebook().codewords.double().numpy()
    centres = None if coder is None else coder.encode(codebook().codewords).detach().double().numpy()

    def shown(rendered):
        return (
            oracles_answers.unit_map(rendered)
            if book is None
            else oracles_answers.codeword_map(rendered, codewords, centres)
        )

    expected, pixels = oracles_answers.fused(blend_weights(cloud, views()), cloud.features.double().numpy(), shown)
    found = fuse(cloud, mode, views())
    features = found.decode(found.latents)
    # KEEP drops what is below 0.001 of the variation between features: at most sqrt(0.001) of each.
    np.testing.assert_allclose(features.numpy(), expected, atol=2e-5 if book is not None else 0.03)
    assert (pixels[:8] > 0.5).sum() >= 6
    assert (pixels[8:] == 0).all()


@pytest.mark.parametrize("mode", ["decouple", "adc", "adc+sc"])
def test_what_no_view_shows_answers_nothing(mode):
    found = fuse(trained(mode), mode, views())
    assert (found.latents[-2:] == 0).all()


@pytest.mark.parametrize("mode", ["decouple", "adc"])
def test_what_learnt_nothing_answers_nothing(mode):
    """Its pixels show all-zero features, which are no codeword, not even the first."""
    cloud = trained(mode)
    cloud = cloud.replace(features=torch.zeros_like(cloud.features))
    features = torch.cat([torch.zeros(9, DIM), codebook().unit[:1]])  # the last, far away, has some
    found = fuse(cloud.replace(features=features), mode, views())
    assert (found.latents == 0).all()


def test_large_views_are_rendered_small(monkeypatch):
    cloud, large = trained("adc"), [view.resized(40, 52) for view in views()]
    monkeypatch.setattr("kfgs.fields.uplift.PIXELS", 130)
    torch.testing.assert_close(fuse(cloud, "adc", large).latents, fuse(cloud, "adc", views()).latents)


# Wrong input

FOUR = random_maps(cameras())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"maps": FOUR[:3]}, ("maps:", "got 3")),
        ({"cameras": [], "maps": []}, ("maps:", "got 0")),
        ({"gaussians": cloud().select(slice(0, 0))}, ("gaussians:", "got none")),
        ({"maps": [FOUR[0], torch.ones(10, 13, 7), *FOUR[2:]]}, ("maps[1]:", "5]", "7)")),
        ({"maps": [torch.ones(4, 5)] * 4}, ("maps[0]:", "[h, w, D]", "got (4, 5)")),
        ({"maps": [torch.ones(3, 10, 13)] * 4}, ("maps[0]:", "[h, w, D]", "got (3, 10, 13)", "from_bchw")),
        ({"maps": [*FOUR[:3], FOUR[3].masked_fill(FOUR[3] == FOUR[3][0, 0, 0], torch.nan)]}, ("maps[3]:", "got NaN")),
        ({"maps": [*FOUR[:3], FOUR[3].masked_fill(FOUR[3] == FOUR[3][0, 0, 0], torch.inf)]}, ("maps[3]:", "got NaN")),
        ({"maps": [torch.zeros(5, 6, 3)] * 4}, ("maps:", "zero", "got 4")),
        ({"maps": [torch.full((5, 6, 3), 1e-37)] * 4}, ("maps:", "longer than 1e-08", "got 4")),
        ({"maps": [torch.full((5, 6, 3), 1e37)] * 4}, ("maps[0]:", "squares", "float32", "got 1e+37", "divide")),
        ({"gaussians": balls([[0.0, 0.0, -2.0]])}, ("cameras:", "show", "got none")),
    ],
)
def test_wrong_input_is_named(change, message):
    refused(lambda: uplift_maps(**({"gaussians": cloud(), "cameras": cameras(), "maps": FOUR} | change)), *message)


def test_blocks_are_averaged_and_the_rest_dropped():
    map = torch.rand(11, 14, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for divisor in (2, 3, 4):
        np.testing.assert_allclose(shrink_map(map, divisor).numpy(), block_means(map.numpy(), divisor), rtol=1e-12)


def test_a_block_with_an_unknown_pixel_is_unknown():
    map = torch.ones(4, 6, 3)
    map[1, 2] = torch.nan
    expected = torch.tensor([[False, True, False], [False, False, False]])
    assert torch.equal(shrink_map(map, 2)[..., 0].isnan(), expected)


def test_the_shrunken_camera_sees_the_shrunken_picture():
    """A world of wide Gaussians looks alike through both, though a row and a column are dropped."""
    K = torch.tensor([[60.0, 0, 33.1], [0, 62.0, 20.4], [0, 0, 1]], dtype=torch.float64)
    camera = Camera(torch.eye(4, dtype=torch.float64), K, 67, 43)
    g = torch.Generator().manual_seed(1)
    n = 12
    gaussians = Gaussians(
        means=torch.randn(n, 3, generator=g, dtype=torch.float64) * torch.tensor([1.0, 0.7, 0.3])
        + torch.tensor([0.0, 0.0, 4.0]),
        quats=torch.randn(n, 4, generator=g, dtype=torch.float64),
        scales=torch.full((n, 3), 0.6, dtype=torch.float64),
        opacities=torch.full((n,), 0.5, dtype=torch.float64),
        features=torch.rand(n, 3, generator=g, dtype=torch.float64),
    )
    small = shrink_camera(camera, 3)
    assert small.size == (14, 22)
    seen, expected = (
        rasterize(gaussians, small, engine="reference").map,
        shrink_map(rasterize(gaussians, camera, engine="reference").map, 3),
    )
    squeezed = rasterize(
        gaussians, camera.resized(14, 22), engine="reference"
    ).map  # the wrong reading: dropped pixels squeezed in
    assert (seen - expected).abs().mean() < 0.01
    assert (squeezed - expected).abs().mean() > 1.5 * (seen - expected).abs().mean()


@pytest.mark.parametrize(("height", "width"), [(107, 107), (90, 120), (48, 64)])
def test_the_working_camera_has_the_pixels_of_the_shrunken_map(height, width, tmp_path):
    """107 pixels are shrunk by 12 to 8 blocks, of which 11 pixels are left over: 107 // 8 is 13."""
    K = torch.tensor([[100.0, 0, width / 2], [0, 100.0, height / 2], [0, 0, 1]])
    camera = Camera(torch.eye(4), K, width, height)
    shrink = next(k for k in range(1, 200) if (height // k) * (width // k) <= 64)
    views = WorkingMaps([camera], [torch.rand(height, width, 3) + 0.1], torch.eye(3), 64, tmp_path)
    for view in (views[0], views[0]):  # made, and read from its file
        assert view.map.shape[:2] == (height // shrink, width // shrink)
        resized = torch.tensor([view.factor / shrink, view.factor / shrink, 1.0])
        torch.testing.assert_close(view.camera.K, K * resized[:, None])
        assert view.scale == pytest.approx((shrink / view.factor) ** 2)
