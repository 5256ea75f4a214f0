import numpy as np
import pytest
import torch

from kfgs.viz.pairs import GAP, picture_grid


def test_each_picture_lies_where_its_row_and_column_say():
    rows = [[torch.full((10, 20, 3), (2 * i + j) / 4) for j in range(2)] for i in range(2)]
    sheet = picture_grid(rows)
    assert sheet.shape == (GAP + 2 * (10 + GAP), GAP + 2 * (20 + GAP), 3)
    assert sheet[GAP + 5, GAP + 5].tolist() == [0, 0, 0]
    assert sheet[GAP + 5, 2 * GAP + 25].tolist() == [64, 64, 64]
    assert sheet[2 * GAP + 15, GAP + 5].tolist() == [128, 128, 128]
    assert sheet[0, 0].tolist() == [255, 255, 255]


def test_a_title_is_drawn_over_its_column_and_nowhere_else():
    pictures = [[np.full((40, 120, 3), 200, np.uint8)] * 2]
    sheet = picture_grid(pictures, ["before", ""])
    head = sheet.shape[0] - 40 - 2 * GAP + GAP
    assert sheet[:head, : GAP + 120].min() < 100
    assert sheet[:head, 2 * GAP + 120 :].min() == 255
    assert (sheet[head : head + 40, GAP : GAP + 120] == 200).all()


@pytest.mark.parametrize(
    ("rows", "titles", "message"),
    [
        ([], (), "rows: expected rows of equally many"),
        ([[np.zeros((2, 2, 3))], []], (), "rows: expected rows of equally many"),
        ([[np.zeros((2, 2, 3))]], ("a", "b"), "titles: expected 1"),
        ([[np.zeros((2, 2, 3)), np.zeros((3, 2, 3))]], (), "H = 2"),
    ],
)
def test_what_does_not_fit_is_refused(rows, titles, message):
    with pytest.raises(ValueError, match=message):
        picture_grid(rows, titles)
