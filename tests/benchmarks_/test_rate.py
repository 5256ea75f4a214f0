"""The benchmark of size against quality: what is stored, which field is scored, and the table and the picture of it."""

import dataclasses

import pytest
import rate
from cases_packed import field

from kfgs.fields.packing import SMALL


class Room:
    """Scores a field by the labels of its Gaussians instead of views, and remembers it."""

    def __init__(self, made):
        self.classes, self.seen = made.classes, []

    def score(self, found, text=None):
        self.seen.append(found.classify(self.classes if text is None else text).labels)
        return {"miou": 80.0, "accuracy": 90.0, "same": 100.0}


@pytest.fixture(scope="module")
def made():
    whole = field("fused", n=500)
    return dataclasses.replace(whole, gaussians=whole.gaussians.replace(labels=None))


def test_the_curve_falls_in_size_as_its_errors_grow(made, tmp_path):
    points = rate.packed(Room(made), made, tmp_path)
    assert [one.name for one in points[:4]] == ["lossless", "fine", "small", "tiny"]
    curve = [one.bytes for one in points if one.kind == "curve"]
    assert curve == sorted(curve, reverse=True)
    assert len(curve) == len(rate.FACTORS)
    assert rate.scaled(1) == SMALL
    assert rate.scaled(100).degrees == 30
    assert len(rate.table(points, len(made)).splitlines()) == len(points) + 2
