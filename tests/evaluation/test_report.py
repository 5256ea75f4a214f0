import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pytest
import torch

from kfgs.evaluation import LabelTruth, MaskAndBoxes, MaskTruth, PointTruth, Report, average
from kfgs.evaluation.report import make_report, plain
from kfgs.pipeline.side_by_side import rank


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


def test_an_infinite_score_survives_json_and_stays_the_best():
    best = make_report(Example(), "kfgs", {"PSNR": math.inf, "hue": math.nan}, [])
    read = Report.from_json(json.loads(json.dumps(best.to_json(), allow_nan=False)))
    assert read.value == math.inf
    assert math.isnan(read["hue"])
    assert list(rank({"good": make_report(Example(), "", {"PSNR": 30.0}, []), "best": read})) == ["best", "good"]


def test_notes_are_kept_and_joined():
    one, two = (make_report(Example(), "kfgs", {"mIoU": 0.5}, [], ["14 texts", scene]) for scene in ("a", "b"))
    assert "  note: 14 texts\n  note: a" in one.text
    assert "note" not in str(one)
    assert Report.from_json(json.loads(json.dumps(one.to_json()))).notes == ("14 texts", "a")
    assert average([one, two]).notes == ("14 texts", "a", "b")
    older = {key: value for key, value in one.to_json().items() if key != "notes"}
    assert Report.from_json(older).notes == ()


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


def test_scenes_are_averaged_alike():
    one, two = (make_report(Example(), "kfgs", {"mIoU": v, "acc": v / 2}, []) for v in (0.2, 0.6))
    both = average([one.of(digests={"scene": "ramen"}), two])
    assert both.scores == pytest.approx({"mIoU": 0.4, "acc": 0.2})
    assert [row["scene"] for row in both.rows] == ["ramen", 1]
    with pytest.raises(ValueError, match="expected the options of the first"):
        average([one, make_report(Example(threshold=0.1), "kfgs", {"mIoU": 0.2}, [])])
    with pytest.raises(ValueError, match="expected at least one, got none"):
        average([])
