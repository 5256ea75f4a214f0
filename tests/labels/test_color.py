import numpy as np
import pytest
import torch
from messages import tells

from kfgs.labels import parse_color

RED = (192 / 255, 64 / 255, 64 / 255)


@pytest.mark.parametrize(
    ("color", "expected"),
    [
        ("#c04040", RED),
        (" #C04040 ", RED),
        ("rgb(192, 64, 64)", RED),
        ("#c44", (204 / 255, 68 / 255, 68 / 255)),
        ("teal", (0.0, 128 / 255, 128 / 255)),
        ("hsl(120, 100%, 50%)", (0.0, 1.0, 0.0)),
        ([0.5, 0, 1], (0.5, 0.0, 1.0)),
        (torch.tensor([0.5, 0.0, 1.0]), (0.5, 0.0, 1.0)),
        (np.array([0.5, 0.0, 1.0]), (0.5, 0.0, 1.0)),
    ],
)
def test_colours_are_read(color, expected):
    assert parse_color(color) == expected


@pytest.mark.parametrize(
    ("color", "message"),
    [
        ("reddish", ("rgb:", "'#c04040'", "got 'reddish'")),
        ("192,64,64", ("rgb:", "colour", "'teal'")),
        ("#c0404080", ("rgb:", "got '#c0404080'")),
        ("", ("rgb:", "colour", "'teal'")),
        ((192, 64, 64), ("rgb:", "8-bit", "255", "got (192, 64, 64)")),
        ((0.1, 0.2), ("rgb:", "got (0.1, 0.2)")),
        ((0.1, float("nan"), 0.2), ("rgb:", "got (0.1, nan, 0.2)")),
        ((True, False, False), ("rgb:", "three")),
        (None, ("rgb:", "got None")),
        (("a", "b", "c"), ("rgb:", "got ('a', 'b', 'c')")),
    ],
)
def test_no_colours_are_refused(color, message):
    with pytest.raises(ValueError, match=tells(*message)):
        parse_color(color)
