import numpy as np
import pytest
import torch
from messages import refused
from oracles_palette import FIRST, worst_distance

from kfgs.viz import palette
from kfgs.viz.palette import PALETTE, name_slots

ROOM = ["wall", "ceiling", "floor", "rug", "window blind", "sofa", "cushion", "blanket", "table", "chair", "stool"]


def test_the_first_colours_stay_what_they_are():
    assert [bytes(row).hex() for row in PALETTE[:20]] == FIRST


@pytest.mark.parametrize(("size", "least"), [(64, 8.9), (256, 3.8)])
def test_colours_differ_for_normal_and_colour_blind_eyes(size, least):
    found = worst_distance(PALETTE[:size], PALETTE[:size])
    np.fill_diagonal(found, np.inf)
    assert found.min() >= least
    assert worst_distance(PALETTE[:size], np.array([[128, 128, 128]])).min() >= 3.8  # grey means "none"


def test_labels_of_any_shape_and_kind():
    labels = torch.tensor([[0, -1, 255], [256, 7, 3]])
    rgb = palette(labels)
    assert (rgb.shape, rgb.dtype) == ((2, 3, 3), np.uint8)
    assert rgb[0, 1].tolist() == [128, 128, 128]
    assert rgb[1, 0].tolist() == rgb[0, 0].tolist() == PALETTE[0].tolist()  # 256 colours, then again
    np.testing.assert_array_equal(palette(labels.numpy().astype(np.int16)), rgb)
    assert palette(np.array([255], dtype=np.uint8)).tolist() == [PALETTE[255].tolist()]
    assert palette(np.empty((0,), dtype=np.int64)).shape == (0, 3)


def test_a_name_has_one_colour_in_every_scene():
    other = ["sky", "chair", "floor", "wall", "sofa"]
    for name in ("chair", "floor", "wall", "sofa"):
        both = [palette(torch.tensor([names.index(name)]), names).tolist() for names in (ROOM, other)]
        assert both[0] == both[1]
    assert palette(torch.tensor([-1]), ROOM).tolist() == [[128, 128, 128]]
    assert name_slots(["Sofa", "window-blind"]) == [name_slots([name])[0] for name in ("couch", "curtain")]
    many = [*ROOM, "thing", "sky", "couch", "vase"]
    assert name_slots(many[::-1]) == name_slots(many)[::-1]  # in any order


def test_names_that_share_a_home():
    home, moved = name_slots(["sofa", "couch"])
    assert home == name_slots(["couch"])[0] != moved  # "sofa" is the first word of the row
    assert name_slots(["couch", "sofa"]) == [moved, home]
    crowd = [f"thing {i}" for i in range(300)]
    assert sorted(name_slots(crowd[:20])) == list(range(20))  # no colour twice, the best ones first
    assert set(name_slots(crowd[:64])) == set(range(64))
    assert set(name_slots(crowd)) == set(range(256))
    assert max(name_slots([*ROOM, "a word of its own"])) < 20


def test_a_class_without_a_name_takes_no_colour_from_one_with_a_name():
    named = ["zebra", "floor", "sofa"]
    slots = name_slots([*named, *(f"class {i}" for i in range(3, 40))])
    assert slots[:3] == name_slots(named)
    assert all(slots[k] == k for k in range(3, 40) if k not in slots[:3])
    assert len(set(slots)) == 40
    assert name_slots([*named, "class 3", "class 4"]) == slots[:5]  # a crop has the colours of its cloud
    numbered = palette(np.array([999]), [f"class {k}" for k in range(1000)])
    assert numbered.tolist() == palette(np.array([999])).tolist() == [PALETTE[name_slots(["class 999"])[0]].tolist()]
    assert name_slots(["class 1000", str(10**30)])[0] == 1000 % 256


def test_wrong_labels_are_named():
    refused(lambda: palette(torch.zeros(3)), "labels:", "got float32", error=TypeError)
    refused(lambda: palette(torch.tensor([0, -2])), "labels:", "-1", "got -2")
    refused(lambda: palette(torch.tensor([2]), ["a", "b"]), "names:", "up to 2", "got 2 names")
