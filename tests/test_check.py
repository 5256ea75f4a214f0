import math
from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from messages import refused, tells

from kfgs._check import as_array, as_tensor, check_range, check_shapes, check_whole, class_indices


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        ([((5, 3), "N 3"), ((4, 9), "N D")], ("x1:", "[N, D]", "N = 5 (from x0)", "got (4, 9)")),
        ([((5, 4), "N 3")], ("x0:", "[N, 3]", "got (5, 4); pass")),  # quotes no size that it brought itself
        ([((5, 3, 1), "N 3")], ("x0:", "[N, 3]", "got (5, 3, 1)")),
        ([((), "N 3")], ("x0:", "[N, 3]", "got ()")),
        ([((4, 5), "C C")], ("x0:", "[C, C]", "got (4, 5)")),
    ],
)
def test_a_shape_that_disagrees_names_what_bound_the_size(arguments, parts):
    with pytest.raises(ValueError, match=tells(*parts)):
        check_shapes(*((f"x{i}", torch.zeros(shape), axes) for i, (shape, axes) in enumerate(arguments)))
    with pytest.raises(TypeError, match=tells("means:", "[N, 3]", "got list", "torch.as_tensor")):
        check_shapes(("means", [[1, 2, 3]], "N 3"))


@pytest.mark.parametrize(
    ("value", "closed", "good"),
    [
        (0.0, (True, True), True),
        (0.0, (False, True), False),
        (1.0, (True, False), False),
        (1 + 1e-9, (True, True), False),
        (math.nan, (True, True), False),
        (1, (True, True), True),
        (np.float32(0.5), (False, False), True),
        (torch.tensor([1]), (True, True), True),
    ],
)
def test_range_and_its_ends(value, closed, good):
    if good:
        check_range("opacity", value, 0, 1, closed=closed)
    else:
        refused(lambda: check_range("opacity", value, 0, 1, closed=closed), "opacity:", "0, 1", f"got {value}")


def test_a_range_without_an_end_is_still_finite():
    refused(lambda: check_range("distance", math.inf, -math.inf), "distance:", "(-inf, inf)", "got inf")
    refused(lambda: check_range("near", -1, 0), "near:", "[0, inf)", "got -1")


@pytest.mark.parametrize("value", [torch.ones(3), np.zeros((2, 2)), True, torch.tensor(True), "0.5", None])
def test_a_range_is_of_one_number(value):
    refused(lambda: check_range("scale", value, 0), "scale:", "expected a number", "pass a float", error=TypeError)


@pytest.mark.parametrize("value", [2.0, math.nan, True, "2"])
def test_whole_numbers_are_integers(value):
    check_whole("epochs", 2, 1)
    refused(lambda: check_whole("epochs", value, 1), "epochs:", "whole number", f"got {value!r}")
    refused(lambda: check_whole("epochs", 0, 1), "epochs:", "[1, inf)", "got 0")


def test_arrays_become_tensors_that_share_their_memory():
    array = np.zeros(3)
    assert as_tensor("x", array, floating=True).dtype == torch.float64
    as_tensor("x", array)[0] = 1
    assert array[0] == 1
    tensor = torch.ones(2)
    assert as_tensor("x", tensor) is tensor


def test_arrays_that_torch_cannot_share_are_copied():
    array = np.arange(3.0)
    assert as_tensor("x", array[::-1]).tolist() == [2, 1, 0]
    array.setflags(write=False)
    assert as_tensor("x", array).tolist() == [0, 1, 2]  # torch would warn
    swapped = as_tensor("x", np.array([1.0, 2.5], dtype=">f4"))
    assert (swapped.dtype, swapped.tolist()) == (torch.float32, [1, 2.5])
    record = np.zeros(3, dtype=[("a", "u1"), ("b", "f4")])
    assert as_tensor("x", record["b"]).tolist() == [0, 0, 0]  # its strides are no multiple of a number


def test_lists_of_numbers_become_tensors():
    rows = as_tensor("rows", [[0, 1.5], (2, 3)], floating=True)
    assert (rows.dtype, rows.tolist()) == (torch.float32, [[0, 1.5], [2, 3]])
    assert as_tensor("rows", [[1, 0], [0, 1]], floating=True).dtype == torch.float32
    assert as_tensor("labels", [2, 0]).dtype == torch.int64
    assert as_tensor("mask", [True, False]).dtype == torch.bool
    for wrong, kind in (([True, False], "bool"), (torch.tensor([1, 2]), "int64"), (np.array([1, 2]), "int64")):
        with pytest.raises(TypeError, match=tells("rows", "floating", kind, ".float()")):
            as_tensor("rows", wrong, floating=True)


class Maps(Sequence):
    def __len__(self):
        return 3

    def __getitem__(self, i):
        raise AssertionError("this would read a file")


@pytest.mark.parametrize(
    ("value", "advice"),
    [
        ("chair", ("str", "'chair'", "embedding")),
        ([[1.0, 2.0], [3.0]], ("list", "rows of equal length")),
        (["chair"], ("list", "pass numbers", "field.query(name)")),
        ([torch.ones(2, requires_grad=True)] * 2, ("list", "pass numbers")),
        ({"a": 1.0}, ("dict", "torch.as_tensor")),
        (SimpleNamespace(codewords=1), ("SimpleNamespace", ".codewords")),
        (Maps(), ("Maps", "torch.as_tensor")),
        (np.ma.array([[99.0]], mask=True), ("masked array", ".filled")),
    ],
)
def test_what_is_no_tensor_is_refused_with_advice(value, advice):
    refused(lambda: as_tensor("rows", value), "rows", *advice, error=TypeError)


def test_tensors_become_arrays():
    assert as_array(torch.ones(2, requires_grad=True)).tolist() == [1, 1]
    assert as_array([1, 2]).tolist() == [1, 2]
    assert as_array(torch.tensor([0.5, 2.0], dtype=torch.bfloat16)).tolist() == [0.5, 2.0]
    for wrong, parts in ((SimpleNamespace(map=1), ("SimpleNamespace", ".map")), ("a.png", ("str", "'a.png'"))):
        refused(lambda wrong=wrong: as_array(wrong, "picture"), "picture", *parts, error=TypeError)


NAMES = ["wall", "Window blind", "chair", "armchair"]


def test_a_name_in_another_case():
    assert class_indices("window BLIND", NAMES) == (1,)
    assert class_indices("chair", ["Chair", "chair", "CHAIR"]) == (1,)  # its own case wins
    refused(lambda: class_indices("chAir", ["Chair", "chair", "CHAIR"]), "'CHAIR' or 'Chair' or 'chair'")


def test_what_is_not_a_name_is_refused():
    refused(lambda: class_indices(None, NAMES), "class:", "got NoneType", error=TypeError)


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
    refused(lambda: class_indices(name, NAMES), "class:", "wall, Window blind, chair, armchair", f"got {name!r}", near)


def test_a_long_list_is_cut_and_no_names_are_named():
    refused(lambda: class_indices("sky", [f"thing {i}" for i in range(100)]), "class:", "19", "80", "got 'sky'")
    refused(lambda: class_indices("sky", ()), "class:", "'sky'", "got none")
