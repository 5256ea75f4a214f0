import json
import math
from dataclasses import dataclass
from typing import ClassVar

import pytest
import torch
from messages import refused

from kfgs.evaluation.report import make_report
from kfgs.evaluation.texts import as_encoder, encode_unit
from kfgs.evaluation.truth import PointTruth
from kfgs.labels import LabelSet


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


def test_texts_become_unit_rows():
    rows = encode_unit(lambda texts: torch.tensor([[3.0, 4.0]] * len(texts)), ["a", "b"])
    assert rows.tolist() == torch.tensor([[0.6, 0.8]] * 2).tolist()
    refused(lambda: encode_unit(lambda texts: torch.ones(3, 2), ["a", "b"]), "expected one row for each of 2 texts")
    refused(lambda: encode_unit(lambda texts: torch.ones(0, 2), []), "texts: expected at least one")


def test_a_label_set_is_an_encoder_of_its_classes_and_negatives():
    table = LabelSet(("wall", "floor"), torch.eye(3)[:2], negatives=torch.eye(3)[2:], negative_names=("stuff",))
    assert as_encoder(table)(["floor", "stuff"]).tolist() == [[0, 1, 0], [0, 0, 1]]
    with pytest.raises(ValueError, match="all 3 texts that the protocol asks, got none of chair, table .2 missing"):
        as_encoder(table)(["wall", "chair", "table"])
    refused(lambda: as_encoder(None), "expected text embeddings, got none")
