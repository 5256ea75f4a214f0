import json
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pytest
import torch

from kfgs.evaluation import LabelTruth, MaskAndBoxes, MaskTruth, PointTruth, Report
from kfgs.evaluation.report import make_report, plain


@dataclass(frozen=True)
class Example:
    name: ClassVar[str] = "example/2"
    about: ClassVar[str] = "counts sheep"
    threshold: float = 0.5
    sizes: tuple[int, ...] = (1, 2)


def test_a_score_travels_with_its_protocol():
    report = make_report(Example(), "kfgs", {"mIoU": 0.83123, "accuracy": 0.9}, [{"view": "a", "IoU": 0.25}])
    assert str(report) == "mIoU 0.831, accuracy 0.900 (example/2)"
    assert report.value == report["mIoU"] == 0.83123
    assert "counts sheep" in report.text
    assert "view a, IoU 0.250" in report.text


def test_an_option_that_is_not_as_published_is_in_the_short_form():
    report = make_report(Example(threshold=0.4), "kfgs", {"mIoU": 0.5}, [])
    assert str(report) == "mIoU 0.500 (example/2, threshold=0.4)"


def test_json_says_how_to_get_the_score_again():
    report = make_report(Example(), "kfgs", {"mIoU": float("nan")}, [{"view": "a", "IoU": float("inf")}])
    data = report.of(command="kfgs evaluate F", digests={"field": "abc"}).to_json()
    assert json.loads(json.dumps(data, allow_nan=False)) == data
    assert data["name"] == "example"
    assert data["version"] == 2
    assert data["scores"] == {"mIoU": None}
    assert data["rows"] == [{"view": "a", "IoU": None}]
    assert data["options"] == {"threshold": 0.5, "sizes": [1, 2]}
    assert data["command"] == "kfgs evaluate F"
    assert data["digests"] == {"field": "abc"}


def test_what_json_cannot_hold_is_named():
    assert plain({1: Path("a"), "b": torch.tensor([1.0]), "c": Example()}) == {
        "1": "a",
        "b": [1.0],
        "c": {"threshold": 0.5, "sizes": [1, 2]},
    }
    with pytest.raises(TypeError, match="expected something that JSON can hold, got object"):
        plain(object())


def test_bad_reports_are_named():
    with pytest.raises(ValueError, match="scores: expected at least one"):
        Report("x/1", {})
    with pytest.raises(KeyError, match="no score 'b'; expected one of a"):
        Report("x/1", {"a": 1.0})["b"]


def test_truths_check_their_shapes():
    with pytest.raises(ValueError, match=r"maps\['a'\]: expected \[H, W\]"):
        LabelTruth(("x",), {"a": torch.zeros(3).long()})
    with pytest.raises(TypeError, match="expected whole numbers"):
        LabelTruth(("x",), {"a": torch.zeros(3, 3)})
    masks = {"x": MaskAndBoxes(torch.ones(2, 3).bool()), "y": MaskAndBoxes(torch.ones(2, 4).bool())}
    with pytest.raises(ValueError, match=r"\['y'\].mask: expected \[H, W\]"):
        MaskTruth({"a": masks})
    with pytest.raises(ValueError, match="labels: expected"):
        PointTruth(torch.zeros(3, 3), torch.zeros(2).long(), {1: "wall"})
    frames = {s: {t: MaskAndBoxes(torch.ones(2, 3).bool()) for t in ts} for s, ts in {"a": "yx", "b": "xz"}.items()}
    assert MaskTruth(frames).texts == ("y", "x", "z")
