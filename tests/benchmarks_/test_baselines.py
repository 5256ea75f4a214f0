"""The baselines of table 1: published sizes, losses against numbers, and each of them learns the small task."""

import pytest
import torch
from baselines import cf3, feature_3dgs, langsplat, langsplatv2, legaussians, occam
from baselines.methods import LabelMaps, LinearDecoder, RenderedMethod
from small_task import MIB, cameras, cloud, task

from kfgs._rows import unit_rows
from kfgs.cameras import resize_map
from kfgs.evaluation import View
from kfgs.splat import rasterize
from kfgs.splat.covariance import covariance_3d

LEARNS_CODES = legaussians.LEGaussiansConfig(
    codes=4, epochs=150, code_rate=1e-2, steps=150, feature_rate=2e-2, network_rate=1e-2
)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def test_storage_and_numbers_of_weights_are_the_published_ones():
    assert langsplat.Autoencoder(512).decoder_parameters == 241_440
    assert langsplat.storage_bytes(572_200, 241_440) / MIB == pytest.approx(20.7, rel=0.01)
    assert legaussians.CodeDecoder(torch.zeros(128, 896)).parameters_stored == 67_072
    assert legaussians.storage_bytes(571_000, 128, 896, 67_072) / MIB == pytest.approx(18.1, abs=0.05)
    assert feature_3dgs.storage_bytes(602_200, 512, 512) / MIB == pytest.approx(1_175.2, rel=1e-3)
    assert feature_3dgs.storage_bytes(607_200, 128, 512) / MIB == pytest.approx(296.5, rel=1e-3)
    model = feature_3dgs.Features(3, 512, feature_3dgs.Feature3DGSConfig.published(128))
    assert sum(value.numel() for value in model.convolution.parameters()) == 66_048


@pytest.mark.parametrize(
    ("baseline", "config", "share"),
    [
        (feature_3dgs, feature_3dgs.Feature3DGSConfig(None, 120, 2e-2, 1e-2), 0.75),
        (feature_3dgs, feature_3dgs.Feature3DGSConfig(4, 120, 2e-2, 1e-2), 0.75),
        (langsplat, langsplat.LangSplatConfig(4, 32, 1e-2, 1_000, False, 120, 2e-2), 0.95),
        (langsplatv2, langsplatv2.LangSplatV2Config(120, 5e-2, 1_000), 1),
        (legaussians, LEARNS_CODES, 0.9),
    ],
)
def test_fit_lowers_the_loss(baseline, config, share):
    found = baseline.fit(task(), config)
    assert found.history[-1]["loss"] < share * found.history[0]["loss"]
    if baseline is feature_3dgs:
        channels = config.channels
        assert found.storage == 4 * (12 * (channels or 8) + (0 if channels is None else 8 * channels + 8))
    if baseline is langsplatv2:
        assert int((found.method.gaussians.features > 0).sum(1).max()) <= 4


def test_cf3_merges_two_gaussians_into_the_moments_of_their_mixture():
    one = cloud(3).replace(features=torch.eye(3))
    merged = cf3.merge_pairs(one, torch.tensor([1.0, 5.0, 3.0]), torch.tensor([[0, 2]]))
    assert torch.equal(merged.means[0], one.means[1])
    mean = 0.25 * one.means[0] + 0.75 * one.means[2]
    offsets = one.means - mean
    both = covariance_3d(one.quats, one.scales) + offsets[:, :, None] * offsets[:, None]
    torch.testing.assert_close(merged.means[1], mean)
    covariance = covariance_3d(merged.quats, merged.scales)[1]
    torch.testing.assert_close(covariance, 0.25 * both[0] + 0.75 * both[2], rtol=1e-4, atol=1e-5)
    assert torch.allclose(merged.features[1], torch.tensor([0.25, 0.0, 0.75]))
    assert float(merged.opacities[1]) == pytest.approx(float(0.25 * one.opacities[0] + 0.75 * one.opacities[2]))


def test_langsplat_losses_against_numbers_and_unit_latents():
    out, wanted = torch.tensor([[1.0, 0.0], [0.0, 1.0]]), torch.tensor([[1.0, 0.0], [1.0, 0.0]])
    # MSE = 2 / 4; cosines of rows 1 and 0; of columns (1,0).(1,1) = 1/sqrt 2 and (0,1).(0,0) = 0
    rows = langsplat.autoencoder_loss(out, wanted, over_batch=False)
    columns = langsplat.autoencoder_loss(out, wanted, over_batch=True)
    assert float(rows) == pytest.approx(0.5 + 1e-3 * 0.5)
    assert float(columns) == pytest.approx(0.5 + 1e-3 * (1 - 0.5 * 2**-0.5))
    model = langsplat.Latents(50, langsplat.LangSplatConfig(), seeded())
    with torch.no_grad():
        model.raw *= torch.linspace(0.1, 1e4, 50)[:, None]
        model.raw[7] = 0
        lengths = model.splatted().norm(dim=1)
    assert torch.allclose(lengths, (torch.arange(50) != 7).float(), atol=1e-5)
    rendered, target = torch.zeros(2, 2, 3, requires_grad=True), torch.full((2, 2, 3), torch.nan)
    target[0, 0] = torch.tensor([0.5, -0.5, 1.0])
    loss = model.loss(rendered, target, 1)  # a mean over masked pixels too
    assert float(loss.detach()) == pytest.approx(2 / 12)
    loss.backward()
    assert torch.allclose(rendered.grad[0, 0], torch.tensor([-1.0, 1.0, -1.0]) / 12)
    assert int(rendered.grad.count_nonzero()) == 3


def test_langsplat_v2_keeps_the_top_4_and_legaussians_balances_its_codes():
    logits = torch.randn(30, 64, generator=seeded())
    weights, best = langsplatv2.sparse_weights(logits), logits.topk(4).indices
    assert torch.equal((weights > 0).sum(1), torch.full((30,), 4))
    assert torch.allclose(weights.gather(1, best), logits.gather(1, best).softmax(1), atol=1e-6)
    rows, codes = torch.tensor([[2.0, 0.0], [0.0, 1.0]]), torch.tensor([[1.0, 0.0], [0.6, 0.8]])
    # cosines [[1, .6], [0, .8]]: chosen 0 and 1, shares 1/2 each; softmax columns sum to 1, so the load is 1/2
    assert float(legaussians.quantiser_loss(rows, codes)) == pytest.approx(1 - 0.9 + 0.5)


def test_occam_takes_the_renderers_weights_at_the_centres_and_averages_unit_features():
    geometry = cloud(60)
    for camera in cameras():
        rendered = rasterize(geometry.replace(features=torch.eye(60)), camera)
        index, weight, _ = occam.centre_weights(geometry, camera)
        found = dict(zip(index.tolist(), weight.tolist(), strict=True))
        for row, mean in zip(rendered.projected.index.tolist(), rendered.projected.means2d, strict=True):
            x, y = (mean - 0.5).floor().long().tolist()
            if 0 <= x < 24 and 0 <= y < 20:
                assert found.get(row, 0.0) == pytest.approx(float(rendered.map[y, x, row]), abs=1e-5)
    one = task()
    found, weights = occam.centre_average(one.geometry, one.cameras, one.maps)
    sums, total = torch.zeros(12, 8), torch.zeros(12)
    for camera, map in zip(one.cameras, one.maps, strict=True):
        large = unit_rows(resize_map(map, camera.size))
        for i, weight, (row, column) in zip(*occam.centre_weights(one.geometry, camera), strict=True):
            sums[i] += weight * large[row, column]
            total[i] += weight
    assert torch.allclose(weights, total, atol=1e-5)
    assert torch.allclose(found[total > 0], (sums / total[:, None])[total > 0], atol=1e-5)
    assert not found[total == 0].any()


def method_of(matrix=None, bias=None):
    """Twelve Gaussians of which one knows nothing, small enough that some pixels stay empty."""
    features = torch.randn(12, 3, generator=seeded(2))
    features[4] = 0
    one = cloud()
    return RenderedMethod("test", one.replace(features=features, scales=0.4 * one.scales), LinearDecoder(matrix, bias))


@pytest.mark.parametrize(("matrix", "bias"), [(False, False), (True, False), (True, True)])
def test_fast_labels_are_the_largest_cosines(matrix, bias):
    A = torch.randn(5, 3, generator=seeded(4)) if matrix else None
    one = method_of(A, torch.randn(5, generator=seeded(5)) if bias else None)
    rows = unit_rows(torch.randn(4, 5 if matrix else 3, generator=seeded(3)))
    for camera in cameras():
        cosines, labels = one.cosines(View("view", camera), rows)[0], one.labels(View("view", camera), rows)
        drawn = ~cosines[..., 0].isnan()
        assert torch.equal(labels >= 0, drawn)
        best = cosines.gather(2, labels.clamp_min(0)[..., None])[..., 0]
        assert torch.allclose(best[drawn], cosines.amax(2)[drawn], atol=1e-5)
        assert 0 < int(drawn.sum()) < drawn.numel()


def test_cosines_are_of_the_rendered_feature_and_votes_are_blended_softmaxes():
    one, camera = method_of(), cameras()[0]
    rows = unit_rows(torch.randn(4, 3, generator=seeded(3)))
    map = rasterize(one.gaussians, camera).map[10, 12]
    assert torch.allclose(one.cosines(View("view", camera), rows)[0, 10, 12], rows @ map / map.norm(), atol=1e-5)
    votes = (100 * one.gaussian_cosines(rows)[0]).softmax(dim=1).nan_to_num()  # Gaussian 4 knows nothing
    blended = rasterize(one.gaussians.replace(features=votes), camera).map
    expected = blended.argmax(dim=2).masked_fill(blended.sum(dim=2) <= 0, -1)
    found = LabelMaps(one, rows, votes=True).labels(View("view", camera), rows)
    assert torch.equal(found, expected)
    assert not torch.equal(found, one.labels(View("view", camera), rows))  # the two rules differ
