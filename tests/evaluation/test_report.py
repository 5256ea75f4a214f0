import json
import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from messages import refused

from kfgs.evaluation.report import make_report
from kfgs.evaluation.truth import PointTruth


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
    other = make_report(Example(threshold=0.4), "kfgs", {"mIoU": 0.5}, [])
    assert str(other) == "mIoU 0.500 (example/2, threshold=0.4)"  # what is not as published is in the short form
    refused(lambda: other["b"], "no score 'b'; expected one of mIoU", error=KeyError)
    refused(lambda: PointTruth(torch.zeros(3, 3), torch.zeros(2).long(), {1: "wall"}), "labels: expected")


def test_json_has_all_that_is_known():
    report = make_report(Example(), "kfgs", {"mIoU": math.nan, "PSNR": math.inf}, [{"IoU": math.inf}], ["14 texts"])
    data = report.to_json()
    assert json.loads(json.dumps(data, allow_nan=False)) == data
    assert data["protocol"] == "example/2"
    assert data["scores"] == {"mIoU": None, "PSNR": "inf"}
    assert data["rows"] == [{"IoU": None}]
    assert data["options"] == {"threshold": 0.5, "sizes": [1, 2]}
    assert data["notes"] == ["14 texts"]
    assert "  note: 14 texts" in report.text
    assert "note" not in str(report)
