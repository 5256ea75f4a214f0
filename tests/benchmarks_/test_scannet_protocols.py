import cases_methods as cases
import numpy as np
import oracles_protocols as dull
import pytest
import torch
from published.scannet_points import ScanNetPoints, class_indices, scannet_classes
from published.scannet_volume import ScanNetVolume, gaussian_truth, significance

from kfgs.evaluation.scannet import nyu40_names
from kfgs.evaluation.truth import PointTruth

NYU = nyu40_names()


def test_classes_are_opengaussians():
    assert [len(scannet_classes(count)[0]) for count in (19, 15, 10)] == [19, 15, 10]
    assert set(scannet_classes(10)[0]) < set(scannet_classes(15)[0]) < set(scannet_classes(19)[0])
    assert dict(zip(*scannet_classes(19), strict=True))[28] == "showercurtain"
    assert class_indices(torch.tensor([4, 0, 2, 39]), [2, 4]).tolist() == [1, -1, 0, -1]
    with pytest.raises(ValueError, match="classes: expected one of 19, 15, 10"):
        ScanNetPoints(classes=20)


def _scene(seed, count=60, points=60):
    rng = np.random.default_rng(seed)
    names = scannet_classes(19)[1]
    own = {name: rng.uniform(0, 0.3, (2, count)) for name in names}
    for values in own.values():
        values[:, 3] = np.nan
    cloud = cases.spread_gaussians(rng, count, scale=0.4)
    where = cloud.means[:points] if points == count else None
    if where is None:
        where = torch.from_numpy(np.c_[rng.uniform(-1.5, 1.5, (points, 2)), rng.uniform(2.5, 5.5, points)]).float()
    labels = torch.from_numpy(rng.choice([0, 1, 2, 4, 5, 13, 33, 40], points))
    return cases.Numbers(names, own=own, gaussians=cloud), PointTruth(where, labels, NYU)


def _remap(labels, ids):
    return np.array([ids.index(label) + 1 if label in ids else 0 for label in labels.tolist()])


def _argmax(method, names, level, unknown):
    values = np.stack([method.own[name][level] for name in names])
    return np.where(np.isnan(values[0]), unknown, 1 + np.argmax(np.nan_to_num(values), axis=0))


@pytest.mark.parametrize("classes", [19, 15, 10])
def test_points_against_loops(classes):
    method, truth = _scene(classes)
    ids, names = scannet_classes(classes)
    gt = _remap(truth.labels, ids)
    gt[method.gaussians.opacities.numpy() < 0.1] = 0
    for unknown, label in (("first class", 1), ("none", 0)):
        report = ScanNetPoints(classes=classes, unknown=unknown, level=1).score(method, truth, (), method.encode)
        want = dull.scannet(_argmax(method, names, 1, label), gt)
        assert tuple(report.scores.values()) == pytest.approx(want, abs=1e-12)


def test_densified_scenes_ask_the_nearest_gaussian():
    method, truth = _scene(1, points=90)
    with pytest.raises(ValueError, match="expected 90 Gaussians .one at each vertex of truth.points., got 60"):
        ScanNetPoints().score(method, truth, (), method.encode)
    report = ScanNetPoints(assign="nearest").score(method, truth, (), method.encode)
    ids, names = scannet_classes(19)
    means = method.gaussians.means.tolist()
    near = np.array([dull.nearest(means, point, 1)[0] for point in truth.points.tolist()])
    gt = _remap(truth.labels, ids)
    gt[method.gaussians.opacities.numpy()[near] < 0.1] = 0
    want = dull.scannet(_argmax(method, names, 0, 1)[near], gt)
    assert tuple(report.scores.values()) == pytest.approx(want, abs=1e-12)


@pytest.mark.parametrize(
    ("nearest", "radius", "balanced", "vote"),
    [(1000, 5.0, True, "near"), (7, 2.0, True, "near"), (1000, 1.5, False, "near"), (1000, 1.5, False, "far")],
)
def test_volume_against_loops(nearest, radius, balanced, vote):
    method, truth = _scene(2, points=150)
    ids, names = scannet_classes(19)
    cloud = method.gaussians
    parts = [x.double().numpy() for x in (cloud.means, cloud.quats, cloud.scales)]
    labels = _remap(truth.labels, ids)
    gt = dull.gaussian_truth(*parts, truth.points.double().numpy(), labels, nearest, radius, balanced, vote == "far")
    options = {"nearest": nearest, "radius": radius, "balanced": balanced, "vote": vote}
    found = gaussian_truth(cloud, truth.points, torch.from_numpy(labels) - 1, **options)
    assert np.array_equal(found.numpy() + 1, gt)
    assert len(set(gt.tolist())) > 3
    weights = parts[2].prod(1) * cloud.opacities.double().numpy()
    np.testing.assert_allclose(significance(cloud), weights, rtol=1e-12)
    protocol = ScanNetVolume(**options)
    report = protocol.score(method, truth, (), method.encode)
    want = dull.scannet(_argmax(method, names, 0, 0), gt, weights)
    assert tuple(report.scores.values()) == pytest.approx(want, abs=1e-12)
