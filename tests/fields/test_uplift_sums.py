"""Views that are added to an uplift: its sums go on, earlier views are not looked at again."""

from dataclasses import replace

import pytest
import torch
from cases_splat import a_camera, gaussians_before
from messages import tells

from kfgs import Camera, Gaussians
from kfgs.fields import UpliftConfig, UpliftSums, uplift_maps
from kfgs.quant import LinearLatents
from kfgs.splat import rasterize

PLAIN = UpliftConfig(corrections=0, keep=1.0)


def cameras(n=8):
    base = a_camera(13, 10, focal=(14.0, 12.0), principal=(5.3, 5.6))
    moved = []
    for i in range(n):
        viewmat = base.viewmat.clone()
        viewmat[:2, 3] += torch.tensor([0.2 * i, -0.1 * i])
        moved.append(replace(base, viewmat=viewmat, name=f"view {i}"))
    return moved


def cloud(n=12):
    return gaussians_before(cameras()[0], n, seed=0, depth=(2.0, 6.0), spread=0.9).replace(features=None)


def random_maps(views, channels=5):
    g = torch.Generator().manual_seed(0)
    return [torch.randn(*view.size, channels, generator=g) for view in views]


def decoded(uplifted):
    return uplifted.latents.decode(uplifted.gaussians.features)


@pytest.mark.parametrize("first", [1, 3, 4])
def test_the_means_are_those_of_one_call_with_all_views(first):
    views, maps, gaussians = cameras(), random_maps(cameras()), cloud()
    old = uplift_maps(gaussians, views[:first], maps[:first], PLAIN)
    both = uplift_maps(gaussians, views[first:], maps[first:], PLAIN, before=old.sums)
    whole = uplift_maps(gaussians, views, maps, PLAIN)
    assert float((decoded(old) - decoded(whole)).abs().max()) > 0.05
    torch.testing.assert_close(decoded(both), decoded(whole), atol=2e-5, rtol=0)
    torch.testing.assert_close(both.pixels, whole.pixels, atol=1e-4, rtol=1e-5)
    torch.testing.assert_close(both.agreement, whole.agreement, atol=2e-5, rtol=0)
    assert (old.sums.views, both.sums.views) == ((first, first), (8, first))


def test_with_given_latents_one_more_view_gives_the_bits_of_one_call():
    views, maps, gaussians = cameras(), random_maps(cameras()), cloud()
    latents = uplift_maps(gaussians, views, maps, PLAIN).latents
    old = uplift_maps(gaussians, views[:7], maps[:7], PLAIN, latents=latents)
    both = uplift_maps(gaussians, views[7:], maps[7:], PLAIN, latents=latents, before=old.sums)
    whole = uplift_maps(gaussians, views, maps, PLAIN, latents=latents)
    assert torch.equal(both.gaussians.features, whole.gaussians.features)
    torch.testing.assert_close(both.pixels, whole.pixels)


@pytest.mark.parametrize("merged", [None, 6])
def test_corrections_are_those_of_one_call_if_both_groups_have_the_same_means(merged):
    views, gaussians = cameras(4), cloud()
    truth = torch.randn(12, 5, generator=torch.Generator().manual_seed(1)).to(gaussians.means)
    maps = [rasterize(gaussians.replace(features=truth), view)[0] for view in views]
    config = UpliftConfig(keep=1.0, max_gaussians=merged, faint=0.0)
    old = uplift_maps(gaussians, views, maps, config)
    both = uplift_maps(gaussians, views, maps, config, before=old.sums)
    whole = uplift_maps(gaussians, views * 2, maps * 2, config)
    bare = uplift_maps(gaussians, views * 2, maps * 2, replace(config, corrections=0))
    assert len(both.gaussians) == len(whole.gaussians) == (merged or 12)
    assert float((decoded(bare) - decoded(whole)).abs().max()) > 0.02
    torch.testing.assert_close(
        decoded(both), decoded(whole), atol=1e-3, rtol=0
    )  # corrections are kept in half precision


def balls(xs):
    n = len(xs)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1)
    return Gaussians(torch.tensor([[x, 0.0, 2.0] for x in xs]), quats, torch.full((n, 3), 0.15), torch.full((n,), 0.9))


def looking(x):
    K = torch.tensor([[16.0, 0, 4], [0, 16, 4], [0, 0, 1]])
    viewmat = torch.eye(4)
    viewmat[0, 3] = -x
    return Camera(viewmat, K, 8, 8, f"at {x}")


def test_new_directions_are_added_only_for_what_the_old_ones_do_not_explain():
    gaussians, told = balls([0.0, 10.0]), []
    x, y, z = (torch.eye(6)[k].expand(8, 8, 6) for k in range(3))
    old = uplift_maps(gaussians, [looking(0.0)] * 2, [y, x], PLAIN)
    assert old.latents.latent == 1  # one Gaussian is seen, so there is one mean: (x + y) / 2
    same = uplift_maps(gaussians, [looking(0.0)], [x + y], PLAIN, before=old.sums, report=told.append)
    assert "none added" in told[1]
    assert torch.equal(same.latents.basis, old.latents.basis)
    more = uplift_maps(gaussians, [looking(10.0)], [z], PLAIN, before=old.sums, report=told.append)
    assert more.latents.latent == old.latents.latent + 1
    assert torch.equal(more.latents.basis[:, : old.latents.latent], old.latents.basis)
    torch.testing.assert_close(decoded(more)[1], torch.eye(6)[2], atol=1e-5, rtol=0)
    torch.testing.assert_close(decoded(more)[0], decoded(old)[0], atol=1e-5, rtol=0)
    full = uplift_maps(gaussians, [looking(10.0)], [z], replace(PLAIN, max_latents=1), before=old.sums)
    assert full.latents.latent == old.latents.latent


def test_only_new_maps_are_read_and_what_is_kept_can_be_saved():
    views, maps, gaussians = cameras(), random_maps(cameras()), cloud().to(torch.float32)
    config = UpliftConfig(max_gaussians=8)
    old = uplift_maps(gaussians, views[:5], maps[:5], config)
    kept = UpliftSums.from_tensors(old.sums.to_tensors())
    one, other = (uplift_maps(gaussians, views[5:], maps[5:], config, before=x) for x in (old.sums, kept))
    assert torch.equal(one.gaussians.features, other.gaussians.features)
    d = old.latents.latent
    numbers = sum(x.nbytes for x in (kept.sums, kept.corrections, kept.shown, kept.agreement))
    assert numbers == 12 * (16 * d + 16)


def test_sums_of_something_else_are_refused():
    views, maps, gaussians = cameras(4), random_maps(cameras(4)), cloud()
    old = uplift_maps(gaussians, views, maps).sums
    with pytest.raises(ValueError, match=tells("before: expected sums of these 3 Gaussians")):
        uplift_maps(cloud(3), views, maps, before=old)
    for config in (PLAIN, UpliftConfig(corrections=2), UpliftConfig(max_gaussians=5)):
        with pytest.raises(ValueError, match="before: expected sums"):
            uplift_maps(gaussians, views, maps, config, before=old)
    assert uplift_maps(gaussians, views, maps, UpliftConfig(corrections=2)).sums is None


def test_new_views_that_show_nothing_change_nothing():
    maps, gaussians = random_maps(cameras(4)), balls([0.0])
    old = uplift_maps(gaussians, [looking(0.0)] * 2, [m[:8, :8] for m in maps[:2]])
    told = []
    more = uplift_maps(gaussians, [looking(50.0)], [maps[2]], before=old.sums, report=told.append)
    assert told[0].startswith("note: the Gaussians fill 0% of the views")
    torch.testing.assert_close(decoded(more), decoded(old), atol=1e-3, rtol=0)


def test_earlier_latents_may_be_more_than_the_working_directions():
    views, maps, gaussians = cameras(), random_maps(cameras(), channels=80), cloud()
    basis = torch.linalg.qr(torch.randn(80, 70, generator=torch.Generator().manual_seed(1)))[0]
    old = uplift_maps(gaussians, views[:4], maps[:4], PLAIN, latents=LinearLatents(basis))
    both = uplift_maps(gaussians, views[4:], maps[4:], PLAIN, before=old.sums)  # its latents are in the sums
    assert torch.equal(both.latents.basis, basis)
    whole = uplift_maps(gaussians, views, maps, PLAIN, latents=LinearLatents(basis))
    torch.testing.assert_close(decoded(both), decoded(whole), atol=2e-5, rtol=0)
