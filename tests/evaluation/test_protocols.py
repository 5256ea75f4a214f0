import cases_methods as cases
import numpy as np
import pytest
import torch
from messages import refused
from PIL import Image

from kfgs.evaluation import LabelTruth, TeacherMethod, View, evaluate_segmentation, get_protocol, score_views
from kfgs.evaluation.label_pictures import load_label_map
from kfgs.evaluation.protocols import KfgsColor, KfgsPooled, KfgsSurface
from kfgs.evaluation.segmentation import PROTOCOL
from kfgs.evaluation.surface import score_surface
from kfgs.evaluation.truth import PointTruth, merge_table
from kfgs.labels import load_label_set, nearest_labels
from kfgs.pipeline import score_teacher, true_labels
from kfgs.scenes import FeatureFolder, load_scene
from kfgs.splat.sh import rgb_to_sh0

NAMES = ("a", "b", "c")


def test_pooled_is_evaluate_segmentation():
    rng = np.random.default_rng(0)
    method = cases.Numbers(NAMES, cases.random_maps(rng, ["x", "y"], NAMES, 2, 9, 12))
    truth = LabelTruth(NAMES, {stem: torch.from_numpy(rng.integers(-1, 3, (18, 24))) for stem in ("x", "y")})
    views = [cases.view(stem, 9, 12) for stem in ("z", "y", "x")]
    report = KfgsPooled(level=1).score(method, truth, views, method.encode)
    labels = {stem: np.argmax([maps[n][1] for n in NAMES], 0) for stem, maps in method.maps.items()}
    large = {stem: torch.from_numpy(small.repeat(2, 0).repeat(2, 1)) for stem, small in labels.items()}
    expected = evaluate_segmentation(large, truth.maps, NAMES)
    assert report["mIoU"] == pytest.approx(expected.miou.value)
    assert report["accuracy"] == pytest.approx(expected.accuracy.value)
    assert str(report) == f"mIoU {report['mIoU']:.3f}, accuracy {report['accuracy']:.3f} (kfgs-pooled/1, level=1)"
    assert "one confusion matrix over all views" in report.text
    without = views[::2]
    refused(lambda: KfgsPooled().score(method, truth, without, method.encode), "got none for y; pass views with these")


def test_the_papers_score_merges_rugs_and_averages_the_ten_classes_with_most_true_pixels():
    """Against loops over pixels. "a", "b", "c" and "d" have as many pixels: of them, "a" is the tenth."""
    names = ("rug", "floor", *"lkjihgfedcba")
    rng, share = np.random.default_rng(0), np.array([3, 5, 12, 11, 10, 9, 8, 7, 6, 5, 2, 2, 2, 2])
    truth = {stem: rng.permutation(np.repeat(np.arange(14), 4 * share)).reshape(12, -1) for stem in "xy"}
    method = cases.Numbers(names, cases.random_maps(rng, ["x", "y"], names, 1, *truth["x"].shape))
    views = [cases.view(stem, *truth["x"].shape) for stem in "xy"]
    asked = LabelTruth(names, {stem: torch.from_numpy(labels) for stem, labels in truth.items()}), views, method.encode
    for stem, maps in method.maps.items():  # no answer where "l" is: its pixels count all the same
        for name in names:
            maps[name][0, truth[stem] == 2] = np.nan
    merged = {stem: np.where(labels == 0, 1, labels) for stem, labels in truth.items()}
    said = {stem: np.argmax([maps[n][0] for n in names], 0) for stem, maps in method.maps.items()}
    said = {stem: np.where(truth[stem] == 2, -1, np.where(labels == 0, 1, labels)) for stem, labels in said.items()}
    pairs = [pair for stem in "xy" for pair in zip(merged[stem].ravel(), said[stem].ravel(), strict=True)]
    pixels = {k: sum(t == k for t, _ in pairs) for k in range(1, 14)}
    chosen = sorted(pixels, key=lambda k: (-pixels[k], names[k]))[:10]
    iou = {k: sum(t == k == p for t, p in pairs) / sum(k in pair for pair in pairs) for k in chosen}
    report = get_protocol("df3dgs").score(method, *asked)
    assert [row["class"] for row in report.rows] == [names[k] for k in chosen]
    assert names[chosen[-1]] == "a"
    assert report["mIoU"] == pytest.approx(np.mean(list(iou.values())))
    assert report["accuracy"] == pytest.approx(np.mean([t == p for t, p in pairs]))
    assert report.notes == (f"classes: {', '.join(names[k] for k in chosen)}",)
    assert KfgsPooled(merged=(("Rug", "Floor"),), most=10).score(method, *asked).scores == report.scores
    assert merge_table(NAMES, (("a", "b"), ("b", "c"))).tolist() == [2, 2, 2, -1]
    refused(lambda: merge_table(NAMES, (("a", "b"), ("b", "a"))), "merged: expected", "circle")
    refused(lambda: merge_table(names, (("rug", "flor"),)), "merged: expected", "got 'flor'; did you mean 'floor'?")
    refused(lambda: KfgsPooled(merged=("rug", "floor")).score(method, *asked), "merged: expected pairs", "got 'rug'")
    refused(lambda: get_protocol("df3dgs", most=0), "most: expected", "got 0")
    assert KfgsPooled().score(method, *asked)["accuracy"] < report["accuracy"]


def test_the_teacher_scores_as_the_demo_says(room):
    scene, classes = load_scene(room), load_label_set(room / "classes.json", room / "text.npy")
    truth = true_labels(scene, room / "labels", "test")
    folder = FeatureFolder(room / "features", list(truth))
    views = [View(scene.stem(i), scene.cameras[i].resized(*folder.shape[:2])) for i in scene.views("test")]
    method = TeacherMethod(folder)
    rows = {name: row for name, row in zip(classes.names, classes.embeddings, strict=True)}
    report = KfgsPooled().score(
        method, LabelTruth(tuple(classes.names), truth), views, lambda texts: torch.stack([rows[t] for t in texts])
    )
    want = score_teacher(lambda stem: folder[folder.stems.index(stem)], truth, classes, (30, 40))
    assert report["mIoU"] == pytest.approx(want.miou.value)
    assert report["accuracy"] == pytest.approx(want.accuracy.value)


def test_surface_carries_labels_to_points_and_leaves_out_what_means_no_class():
    rng, asked, names = np.random.default_rng(1), [], {2: "a", 5: "b", 9: "c"}
    own = {name: rng.uniform(size=(1, 50)) for name in NAMES}
    for values in own.values():
        values[:, :5] = np.nan
    method = cases.Numbers(NAMES, own=own, gaussians=cases.spread_gaussians(rng, 50))
    points = method.gaussians.means[rng.integers(0, 50, 80)] + 0.05 * torch.randn(80, 3)
    ids = torch.from_numpy(rng.choice([0, 2, 5, 7, 9], 80))

    def encode(texts):
        asked.extend(texts)
        return method.encode(texts)

    report = KfgsSurface().score(method, PointTruth(points, ids, {**names, 7: "Unlabelled"}), (), encode)
    labels = np.argmax([own[n][0] for n in NAMES], 0)
    labels[:5] = -1
    moved = nearest_labels(method.gaussians.means, torch.from_numpy(labels), points)
    right = [moved.labels[i] == {2: 0, 5: 1, 9: 2}[int(t)] for i, t in enumerate(ids) if int(t) in names]
    assert (report["agreement"], asked) == (pytest.approx(np.mean(right)), ["a", "b", "c"])
    assert report.notes == (f"not scored, no class: Unlabelled ({int((ids == 7).sum())} points)",)
    unnamed = KfgsSurface().score(method, PointTruth(points, ids, names), (), method.encode)
    assert (unnamed.scores, unnamed.rows, unnamed.notes) == (report.scores, report.rows, ())
    with pytest.raises(ValueError, match="truth: expected names of classes, got void"):
        KfgsSurface().score(method, PointTruth(points, ids, {7: "void"}), (), method.encode)
    assert str(report).endswith("(kfgs-surface/1)")
    with pytest.raises(TypeError, match="expected one with Gaussians"):
        KfgsSurface().score(TeacherMethod({}), PointTruth(points, ids, {2: "a"}), (), method.encode)
    found = score_surface(method.gaussians.means, torch.from_numpy(labels), points, torch.zeros(80).long())
    assert str(found).endswith("(kfgs-surface/1)")
    assert found.rows[0]["points"] == 80
    merged = KfgsSurface(merged=(("a", "b"),)).score(method, PointTruth(points, ids, names), (), method.encode)
    moved_labels = moved.labels.where(moved.labels != 0, 1)
    both = [moved_labels[i] == {2: 1, 5: 1, 9: 2}[int(t)] for i, t in enumerate(ids) if int(t) in names]
    assert merged["agreement"] == pytest.approx(np.mean(both))
    none = score_surface(torch.zeros(3, 3), torch.full((3,), -1), torch.zeros(2, 3), torch.tensor([0, 1]))
    assert (none.value, none.rows[0]["labelled"], none.rows[0]["points"]) == (0, 0, 2)  # without a label no agreement
    with pytest.raises(ValueError, match="expected some point with a class"):
        score_surface(method.gaussians.means, torch.from_numpy(labels), points, torch.full((80,), -1))


def test_pictures_are_scored_as_score_views_does(room):
    scene = load_scene(room)
    with np.load(room / "surface.npz") as surface:
        points = torch.from_numpy(surface["points"]).float()
    colors = torch.rand(len(points), 3, generator=torch.Generator().manual_seed(0))
    cloud = cases.spread_gaussians(np.random.default_rng(2), len(points))
    cloud = cloud.replace(means=points, scales=torch.full((len(points), 3), 0.05), sh=rgb_to_sh0(colors)[:, None])
    truth, views = KfgsColor.open(scene, room)
    assert [view.stem for view in views] == [scene.stem(i) for i in scene.views("test")]
    want = score_views(cloud, scene)
    assert KfgsColor().score(cloud, truth).scores == {"PSNR": want.psnr.value, "SSIM": want.ssim.value}
    assert "(kfgs-color/1)" in str(want)
    refused(lambda: KfgsColor.open(scene, room, room), "truth: expected none with kfgs-color/1")


def test_protocols_are_found_by_name():
    assert get_protocol("kfgs-pooled", level=2) == get_protocol("kfgs-pooled/1", level=2) == KfgsPooled(level=2)
    refused(lambda: get_protocol("kfgs-poled"), "expected one of kfgs-pooled/1, ", "did you mean kfgs-pooled/1")
    refused(lambda: get_protocol("kfgs-pooled", threshold=0.5), "threshold", error=TypeError)


def _save(path, rows):
    Image.fromarray(np.array(rows, np.uint8)).save(path)
    return path


def test_pooled_scores_by_hand(tmp_path):
    truth = {"a": _save(tmp_path / "a.png", [[0, 0], [1, 255]]), "b": _save(tmp_path / "b.png", [[1, 1], [1, 1]])}
    predictions = {"a": torch.tensor([[0, 1], [1, 0]]), "b": torch.tensor([[1, 1], [1, -1]])}
    report = evaluate_segmentation(predictions.__getitem__, truth, ["x", "y", "absent"])
    # x: 1 hit, union 2 (the void pixel counts nowhere); y: 4 hits, union 5 truth + 1 false; absent: left out
    assert report.iou[0] == pytest.approx(1 / 2)
    assert report.iou[1] == pytest.approx(4 / 6)
    assert torch.isnan(report.iou[2])
    assert report.miou.value == pytest.approx((1 / 2 + 4 / 6) / 2)
    assert str(report.miou) == "mIoU 0.583 (kfgs-pooled/1)"
    assert report.miou.text.startswith("mIoU 0.5833 (kfgs-pooled/1: one confusion matrix")
    assert report.accuracy.value == pytest.approx(5 / 7)
    assert report.to_json()["iou"]["absent"] is None
    assert report.to_json()["protocol"] == PROTOCOL


def test_bad_input_is_named(tmp_path):
    refused(lambda: evaluate_segmentation(lambda stem: torch.zeros(1, 1), {}, ["x"]), "truth:", "got none")
    path = _save(tmp_path / "a.png", [[0, 7]])
    void = {"a": torch.full((1, 2), -1)}
    refused(lambda: evaluate_segmentation(void, {"a": path}, ["x", "y"]), "a.png:", "got 7")
    refused(lambda: evaluate_segmentation(void, void, ["x"]), "truth:", "pixel", "void")
    truth = {"a": torch.tensor([[0, 1]])}
    for wrong, error in ((-2, ValueError), (4, ValueError), (0.7, TypeError)):
        said = {"a": torch.tensor([[0, wrong]])}
        refused(lambda said=said: evaluate_segmentation(said, truth, NAMES), "pred: expected", "labels", error=error)
    (tmp_path / "broken.png").write_bytes(b"PNG?")
    refused(lambda: load_label_map(tmp_path / "broken.png"), "broken.png:", "labels", "decoded")
    refused(lambda: load_label_map(tmp_path / "none.png"), "none.png:", "no such file", error=FileNotFoundError)
    Image.fromarray(np.zeros((2, 2, 3), np.uint8)).save(tmp_path / "rgb.png")
    refused(lambda: load_label_map(tmp_path / "rgb.png"), "rgb.png:", "8-bit")
