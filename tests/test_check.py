import math
from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from messages import tells

from kfgs._check import as_array, as_tensor, check_choice, check_range, check_shapes, check_whole


def test_sizes_are_returned_by_name():
    sizes = check_shapes(("means", torch.zeros(5, 3), "N 3"), ("features", np.zeros((5, 7)), "N D"))
    assert sizes == {"N": 5, "D": 7}


def test_missing_argument_is_skipped():
    assert check_shapes(("features", None, "N D"), ("means", torch.zeros(2, 3), "N 3")) == {"N": 2}


def test_scalar_has_no_axes():
    assert check_shapes(("loss", torch.tensor(1.0), "")) == {}


def test_message_names_the_argument_that_bound_the_size():
    with pytest.raises(ValueError, match=tells("features:", "[N, D]", "N = 5", "got (4, 9)")):
        check_shapes(("means", torch.zeros(5, 3), "N 3"), ("features", torch.zeros(4, 9), "N D"))


@pytest.mark.parametrize("shape", [(5, 4), (5,), (5, 3, 1), ()])
def test_number_and_count_of_axes_must_match(shape):
    with pytest.raises(ValueError, match=tells("means:", "[N, 3]", "got (")):
        check_shapes(("means", torch.zeros(shape), "N 3"))


def test_axis_named_twice_in_one_argument_must_agree():
    assert check_shapes(("confusion", torch.zeros(4, 4), "C C")) == {"C": 4}
    with pytest.raises(ValueError, match=tells("confusion:", "[C, C]", "got (4, 5)")):
        check_shapes(("confusion", torch.zeros(4, 5), "C C"))


def test_failed_argument_binds_nothing():
    """The message of a wrong argument does not quote sizes that the argument itself brought."""
    with pytest.raises(ValueError, match=tells("a:", "[N, 3]", "got (9, 2)")):
        check_shapes(("a", torch.zeros(9, 2), "N 3"))


def test_something_without_a_shape():
    with pytest.raises(TypeError, match=tells("means:", "[N, 3]", "got list", "torch.as_tensor")):
        check_shapes(("means", [[1, 2, 3]], "N 3"))


def test_choice():
    check_choice("engine", "numba", ("auto", "numba"))
    with pytest.raises(ValueError, match=tells("engine:", "'auto', 'numba'", "got 'Numba'", "did you mean 'numba'?")):
        check_choice("engine", "Numba", iter(("auto", "numba")))


@pytest.mark.parametrize(
    ("value", "closed", "good"),
    [
        (0.0, (True, True), True),
        (0.0, (False, True), False),
        (1.0, (True, True), True),
        (1.0, (True, False), False),
        (0.5, (False, False), True),
        (-1e-9, (True, True), False),
        (1 + 1e-9, (True, True), False),
        (math.nan, (True, True), False),
    ],
)
def test_range_and_its_ends(value, closed, good):
    if good:
        check_range("opacity", value, 0, 1, closed=closed)
    else:
        with pytest.raises(ValueError, match=tells("opacity:", "0, 1", f"got {value}")):
            check_range("opacity", value, 0, 1, closed=closed)


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan])
def test_range_without_an_end_is_still_finite(value):
    with pytest.raises(ValueError, match=tells("distance:", "(-inf, inf)", f"got {value}")):
        check_range("distance", value, -math.inf)


def test_range_prints_an_endless_side_as_open():
    with pytest.raises(ValueError, match=tells("near:", "[0, inf)", "got -1")):
        check_range("near", -1, 0)


@pytest.mark.parametrize("value", [torch.ones(3), np.zeros((2, 2)), torch.ones(0)])
def test_a_range_is_of_one_number(value):
    with pytest.raises(TypeError, match=tells("scale:", "expected a number", "pass a float")):
        check_range("scale", value, 0)
    check_range("scale", torch.tensor(1.0), 0)


@pytest.mark.parametrize("value", [2.0, 2.5, math.nan, True, "2"])
def test_whole_numbers_are_integers(value):
    check_whole("epochs", 2, 1)
    with pytest.raises(ValueError, match=tells("epochs:", "whole number", f"got {value!r}")):
        check_whole("epochs", value, 1)
    with pytest.raises(ValueError, match=tells("epochs:", "[1, inf)", "got 0")):
        check_whole("epochs", 0, 1)


def test_arrays_become_tensors_that_share_their_memory():
    array = np.zeros(3)
    assert as_tensor("x", array, floating=True).dtype == torch.float64
    as_tensor("x", array)[0] = 1
    assert array[0] == 1
    tensor = torch.ones(2)
    assert as_tensor("x", tensor) is tensor


@pytest.mark.parametrize(
    ("value", "advice"),
    [
        ("chair", ("str", "'chair'", "embedding")),
        ([[1.0, 2.0], [3.0]], ("list", "rows of equal length")),
        (["chair"], ("list", "pass numbers")),
        ([torch.ones(2, requires_grad=True)] * 2, ("list", "pass numbers")),
        ({"a": 1.0}, ("dict", "torch.as_tensor")),
        (SimpleNamespace(codewords=1), ("SimpleNamespace", ".codewords")),
        (None, ("NoneType",)),
        (np.ma.array([[99.0]], mask=True), ("masked array", ".filled")),
    ],
)
def test_what_is_no_tensor_is_refused_with_advice(value, advice):
    with pytest.raises(TypeError, match=tells("rows", *advice)):
        as_tensor("rows", value)


def test_numpy_has_no_bfloat16():
    assert as_array(torch.tensor([0.5, 2.0], dtype=torch.bfloat16)).tolist() == [0.5, 2.0]


def test_lists_of_numbers_become_tensors():
    rows = as_tensor("rows", [[0, 1.5], (2, 3)], floating=True)
    assert rows.dtype == torch.float32
    assert rows.tolist() == [[0, 1.5], [2, 3]]
    assert as_tensor("labels", [2, 0]).dtype == torch.int64
    assert as_tensor("mask", [True, False]).dtype == torch.bool
    with pytest.raises(TypeError, match=tells("rows", "bool", "floating")):
        as_tensor("rows", [True, False], floating=True)


def test_whole_numbers_of_a_list_are_floats_where_floats_are_meant():
    """But not those of a tensor or an array, which say what they are: they are refused."""
    assert as_tensor("rows", [[1, 0], [0, 1]], floating=True).dtype == torch.float32
    for whole in (torch.tensor([1, 2]), np.array([1, 2])):
        with pytest.raises(TypeError, match=tells("rows", "int64", ".float()")):
            as_tensor("rows", whole, floating=True)


def test_the_other_byte_order_is_converted():
    found = as_tensor("x", np.array([1.0, 2.5], dtype=">f4"))
    assert (found.dtype, found.tolist()) == (torch.float32, [1, 2.5])
    assert as_tensor("x", np.array([1, 2], dtype=">i8")).tolist() == [1, 2]


def test_a_column_of_a_record_is_copied():
    """Its strides are no multiple of a number: torch refuses to share it."""
    record = np.zeros(3, dtype=[("a", "u1"), ("b", "f4")])
    assert as_tensor("x", record["b"]).tolist() == [0, 0, 0]


def test_arrays_that_torch_cannot_share_are_copied():
    array = np.arange(3.0)
    assert as_tensor("x", array[::-1]).tolist() == [2, 1, 0]
    array.setflags(write=False)
    assert as_tensor("x", array).tolist() == [0, 1, 2]  # torch would warn


def test_our_own_sequences_are_not_read():
    class Maps(Sequence):
        def __len__(self):
            return 3

        def __getitem__(self, i):
            raise AssertionError("this would read a file")

    with pytest.raises(TypeError, match=tells("maps", "Maps", "torch.as_tensor")):
        as_tensor("maps", Maps())


def test_tensors_become_arrays():
    assert as_array(torch.ones(2, requires_grad=True)).tolist() == [1, 1]
    assert as_array([1, 2]).tolist() == [1, 2]
    with pytest.raises(TypeError, match=tells("picture", "SimpleNamespace", ".map")):
        as_array(SimpleNamespace(map=1), "picture")
    with pytest.raises(TypeError, match=tells("picture", "str", "'a.png'")):
        as_array("a.png", "picture")


@pytest.mark.parametrize("wrong", [True, torch.tensor(True), "0.5", None])
def test_only_numbers_are_numbers(wrong):
    with pytest.raises(TypeError, match=tells("threshold: expected a number", "pass a float")):
        check_range("threshold", wrong, 0, 1)


@pytest.mark.parametrize("right", [1, 0.5, np.float32(0.5), torch.tensor(0.5), torch.tensor([1])])
def test_numbers_of_every_library_are_numbers(right):
    check_range("threshold", right, 0, 1)
