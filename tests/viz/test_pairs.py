import numpy as np
import pytest
import torch

from kfgs.viz.pictures import GAP, picture_grid


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


def test_a_coarse_map_beside_its_photo_repeats_pixels():
    coarse = np.arange(18, dtype=np.uint8).reshape(2, 3, 3) * 10
    sheet = picture_grid([[np.zeros((8, 12, 3)), coarse]], width=12)
    shown = sheet[GAP : GAP + 8, 2 * GAP + 12 : 2 * GAP + 24]
    assert (shown == coarse.repeat(4, 0).repeat(4, 1)).all()


def test_a_large_photo_is_averaged_and_keeps_its_proportions():
    photo = np.zeros((6, 4, 3), np.uint8)
    photo[::2, ::2] = 200  # a quarter of every 2 x 2 block
    sheet = picture_grid([[photo]], width=2)
    assert sheet.shape == (GAP + 3 + GAP, GAP + 2 + GAP, 3)
    assert (sheet[GAP : GAP + 3, GAP : GAP + 2] == 50).all()


def test_the_first_picture_gives_the_proportions():
    high, wide = np.full((4, 2, 3), 10, np.uint8), np.full((2, 4, 3), 90, np.uint8)
    assert picture_grid([[high, wide]], width=8).shape == (2 * GAP + 16, 3 * GAP + 16, 3)
    assert picture_grid([[wide, high]], width=8).shape == (2 * GAP + 4, 3 * GAP + 16, 3)


def test_floats_and_bytes_of_the_own_size_stay_as_they_are():
    rows = [[torch.rand(5, 7, 3, generator=torch.Generator().manual_seed(0)), np.full((5, 7, 3), 9, np.uint8)]]
    assert (picture_grid(rows, width=7) == picture_grid(rows)).all()


@pytest.mark.parametrize("width", [0, 2.5])
def test_a_width_is_a_positive_whole_number(width):
    with pytest.raises(ValueError, match=rf"width: expected a positive whole number of pixels, got {width}; pass an"):
        picture_grid([[np.zeros((2, 2, 3))]], width=width)


def test_an_empty_picture_cannot_be_resized():
    with pytest.raises(ValueError, match="rows: expected pictures of at least one pixel, got an empty one; leave it"):
        picture_grid([[np.zeros((2, 2, 3)), np.zeros((0, 2, 3))]], width=2)


@pytest.mark.parametrize(
    ("rows", "titles", "message"),
    [
        ([], (), "rows: expected rows of equally many"),
        ([[np.zeros((2, 2, 3))], []], (), "rows: expected rows of equally many"),
        ([[np.zeros((2, 2, 3))]], ("a", "b"), "titles: expected 1"),
        (
            [[np.zeros((2, 2, 3)), np.zeros((3, 2, 3))]],
            (),
            r"rows\[0\]\[1\]: .*H = 2, W = 2 .*got \(3, 2, 3\); say .*width=2",
        ),
        ([[np.zeros((2, 2, 3)), np.zeros((2, 2))]], (), r"rows\[0\]\[1\]: expected \[H, W, 3\], got \(2, 2\)"),
    ],
)
def test_what_does_not_fit_is_refused(rows, titles, message):
    with pytest.raises(ValueError, match=message):
        picture_grid(rows, titles)
