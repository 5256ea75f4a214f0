import cases_methods as cases
import numpy as np
import oracles_protocols as dull
import pytest
import torch
from published.class_lists import load_classes
from published.scenesplat import SceneSplatBench, match_names

from kfgs.evaluation.scannet import nyu40_names
from kfgs.evaluation.truth import PointTruth

LISTS = load_classes("scenesplat")
USED = ("wall", "floor", "chair", "table", "sink")
OTHERS = ("something else",)


def _scene(seed, texts, gaussians=70, points=90):
    rng = np.random.default_rng(seed)
    own = {text: rng.uniform(0, 0.3, (1, gaussians)) for text in texts}
    for text in texts:
        if text.removeprefix("this is a ") in USED:
            own[text] += 0.15
        own[text][:, :9] = np.nan
    cloud = cases.spread_gaussians(rng, gaussians)
    where = torch.from_numpy(np.c_[rng.uniform(-1, 1, (points, 2)), rng.uniform(3, 5, points)]).float()
    names = {3: "chair", 7: "wall", 11: "floor", 12: "table", 40: "sink", 41: "something else"}
    labels = torch.from_numpy(rng.choice([-1, *names], points))
    truth = PointTruth(where, labels, names, instances=torch.from_numpy(rng.integers(-1, 6, points)))
    return cases.Numbers(texts, own=own, gaussians=cloud), truth


def _expected(method, truth, texts, classes, protocol):
    values = np.stack([method.own[text][0] for text in texts])
    labels = np.where(np.isnan(values[0]), -1, np.argmax(np.nan_to_num(values), axis=0))
    if protocol.least_cosine is not None:
        labels = np.where(np.nan_to_num(values, nan=-2).max(0) < protocol.least_cosine, -1, labels)
    means = method.gaussians.means.tolist()
    keep = [i for i in range(len(labels)) if labels[i] >= 0 or not protocol.drop_unknown]
    pred = dull.vote_nearest(truth.points.tolist(), [means[i] for i in keep], labels[keep], protocol.neighbours)
    if protocol.within_instances:
        for instance in range(6):  # the lowest of the most frequent
            inside = truth.instances.numpy() == instance
            pred[inside] = np.bincount(pred[inside] + 1).argmax() - 1
    gt = [classes.index(truth.names[i]) if truth.names.get(i) in classes else -1 for i in truth.labels.tolist()]
    return pred, np.array(gt)


@pytest.mark.parametrize(
    "options",
    [{"within_instances": True}, {"neighbours": 3, "drop_unknown": True}, {"least_cosine": 0.35, "neighbours": 5}],
)
def test_several_scenes_share_one_matrix(options):
    classes, dropped = LISTS["scannet20"]["classes"], LISTS["scannet20"]["dropped"]
    texts = [f"this is a {name}" for name in classes]
    protocol = SceneSplatBench(**options, ignored=OTHERS)
    scenes = [_scene(seed, texts) for seed in (0, 1)]
    both = [_expected(*scene, texts, classes, protocol) for scene in scenes]
    report = protocol.score_scenes(scenes, scenes[0][0].encode)
    pred, gt = (np.concatenate(parts) for parts in zip(*both, strict=True))
    want = dull.scenesplat(pred, gt, classes, dropped)
    assert tuple(report.scores.values()) == pytest.approx(want, abs=1e-12)
    assert list(report.scores) == ["f-mIoU", "f-mAcc", "mIoU", "mAcc", "accuracy"]
    assert {row["class"] for row in report.rows} == set(USED)
    alone = protocol.score(*scenes[0], (), scenes[0][0].encode)
    assert tuple(alone.scores.values()) == pytest.approx(dull.scenesplat(*both[0], classes, dropped), abs=1e-12)


def test_holicity_asks_six_prompts_for_four_classes():
    prompts = LISTS["holicity4"]["prompts"]
    texts = [prompt for prompt, _ in prompts]
    method, truth = _scene(3, texts)
    names = dict(zip((3, 7, 11, 12), LISTS["holicity4"]["classes"], strict=True))
    truth = PointTruth(truth.points, truth.labels, names)
    report = SceneSplatBench(benchmark="holicity4", neighbours=4).score(method, truth, (), method.encode)
    values = np.stack([method.own[text][0] for text in texts])
    six = np.where(np.isnan(values[0]), -1, np.argmax(np.nan_to_num(values), axis=0))
    labels = np.array([prompts[i][1] if i >= 0 else -1 for i in six])
    pred = dull.vote_nearest(truth.points.tolist(), method.gaussians.means.tolist(), labels, 4)
    gt = np.array([[3, 7, 11, 12].index(i) if i in (3, 7, 11, 12) else -1 for i in truth.labels.tolist()])
    want = dull.scenesplat(pred, gt, LISTS["holicity4"]["classes"], [])
    assert tuple(report.scores.values()) == pytest.approx(want, abs=1e-12)
    assert report["f-mIoU"] == report["mIoU"]


def _named(labels, names):
    return PointTruth(torch.zeros(len(labels), 3), torch.tensor(labels), names)


NYU40 = nyu40_names()


@pytest.mark.parametrize(("name", "ceiling"), [("scannet20", -1), ("matterport21", 20)])
def test_all_names_of_scannet_find_their_class(name, ceiling):
    classes = LISTS[name]["classes"]
    # ids of NYU40: wall, showercurtain, otherfurniture, ceiling, blinds (twice), none, not in the table
    found = match_names(_named([1, 28, 39, 22, 13, 13, 0, 77], NYU40), classes)
    assert found.labels.tolist() == [0, 15, 19, ceiling, -1, -1, -1, -1]
    assert found.left_out == ({"blinds": 2} if ceiling == 20 else {"blinds": 2, "ceiling": 1})
