import numpy as np
import pytest
import torch
from messages import refused
from PIL import Image

from kfgs.evaluation import evaluate_segmentation
from kfgs.evaluation.label_pictures import load_label_map
from kfgs.evaluation.segmentation import PROTOCOL


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
    (tmp_path / "broken.png").write_bytes(b"PNG?")
    refused(lambda: load_label_map(tmp_path / "broken.png"), "broken.png:", "labels", "decoded")
    refused(lambda: load_label_map(tmp_path / "none.png"), "none.png:", "no such file", error=FileNotFoundError)
    Image.fromarray(np.zeros((2, 2, 3), np.uint8)).save(tmp_path / "rgb.png")
    refused(lambda: load_label_map(tmp_path / "rgb.png"), "rgb.png:", "8-bit")
