import numpy as np
import pytest
import torch

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
        ("reddish", "rgb: expected a colour such as '#c04040', .* got 'reddish'; write one of these"),
        ("192,64,64", "rgb: expected a colour such as"),
        ("#c0404080", "rgb: expected a colour without alpha, got '#c0404080'; use the Opacity edit"),
        ("", "rgb: expected a colour such as"),
        ((192, 64, 64), "rgb: expected three numbers in .*; divide 8-bit colours by 255"),
        ((0.1, 0.2), "rgb: expected three numbers"),
        ((0.1, float("nan"), 0.2), "rgb: expected three numbers"),
        ((True, False, False), "rgb: expected three numbers"),
        (None, "rgb: expected three numbers"),
        (("a", "b", "c"), "rgb: expected three numbers"),
    ],
)
def test_no_colours_are_refused(color, message):
    with pytest.raises(ValueError, match=message):
        parse_color(color)
