import pytest
from messages import tells

from kfgs._names import class_indices

NAMES = ["wall", "Window blind", "chair", "armchair"]


def test_a_name_is_its_place():
    assert [class_indices(name, NAMES) for name in NAMES] == [(0,), (1,), (2,), (3,)]


def test_a_name_in_another_case():
    assert class_indices("window BLIND", NAMES) == (1,)
    assert class_indices("chair", ["Chair", "chair", "CHAIR"]) == (1,)  # its own case wins
    with pytest.raises(ValueError, match=tells("class:", "got 'chAir'", "'CHAIR' or 'Chair' or 'chair'")):
        class_indices("chAir", ["Chair", "chair", "CHAIR"])


def test_several_labels_of_one_name():
    names = ["chair", "wall", "chair", "Chair"]
    assert class_indices("chair", names) == (0, 2)
    assert class_indices("WALL", names) == (1,)
    assert class_indices("CHAIR", ["Chair", "wall", "Chair"]) == (0, 2)


def test_what_is_not_a_name_is_refused():
    with pytest.raises(TypeError, match=tells("class:", "got NoneType")):
        class_indices(None, NAMES)


@pytest.mark.parametrize(
    ("name", "near"),
    [
        ("chiar", "'chair'"),
        ("chairs", "'chair' or 'armchair'"),
        ("window blinds", "'Window blind'"),
        ("blind", "'Window blind'"),
        ("zebra", "take one of these classes"),
        ("", "take one of these classes"),
    ],
)
def test_an_unknown_name_meets_the_near_ones(name, near):
    with pytest.raises(ValueError, match=tells("class:", "wall, Window blind, chair, armchair", f"got {name!r}", near)):
        class_indices(name, NAMES)


def test_a_long_list_is_cut_and_no_names_are_named():
    with pytest.raises(ValueError, match=tells("class:", "19", "80", "got 'sky'")):
        class_indices("sky", [f"thing {i}" for i in range(100)])
    with pytest.raises(ValueError, match=tells("class:", "'sky'", "got none")):
        class_indices("sky", ())
