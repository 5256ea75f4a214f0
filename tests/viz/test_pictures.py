import numpy as np
import pytest
import torch
from messages import tells
from PIL import Image

from kfgs.viz import overlay_labels, palette
from kfgs.viz.pictures import GAP, draw_legend, legend_strip, picture_grid, save_picture


def two_halves(height=20, width=60):
    labels = torch.zeros(height, width, dtype=torch.int64)
    labels[:, width // 2 :] = 3
    labels[0, 0] = -1
    return torch.full((height, width, 3), 0.5), labels


def test_overlay_blends_photo_and_palette_and_darkens_borders():
    image, labels = two_halves()
    labels[0, 0] = 0
    picture = overlay_labels(image, labels, alpha=0.25)
    assert (picture.shape, picture.dtype) == ((20, 60, 3), np.uint8)
    expected = 0.75 * 0.5 * 255 + 0.25 * palette(labels).astype(np.float64)
    expected[:, 29:31] *= 0.35  # both sides of the border
    assert np.abs(picture - expected).max() <= 0.5
    np.testing.assert_array_equal(overlay_labels(image.numpy(), labels.numpy(), alpha=0.25), picture)


def test_legend_shows_each_present_class_once_in_its_colour():
    _, labels = two_halves()
    names = [f"class {i}" for i in range(6)]
    strip = legend_strip(labels, names, 200)
    for label, there in ((-1, True), (0, True), (3, True), (1, False), (2, False)):
        matches = (strip == palette(np.array(label), names)).all(axis=-1).sum()
        assert (matches > 20) == there, label
    image, labels = two_halves(width=200)
    picture = overlay_labels(image, labels, names)
    np.testing.assert_array_equal(picture[20:], strip)
    narrow = legend_strip(labels, names, 90)
    assert narrow.shape[1] == 90
    assert narrow.shape[0] > strip.shape[0]  # wrapped


def test_legend_column_has_one_class_per_line():
    names = ["a", "b", "c", "a long name"]
    rows = [draw_legend(torch.arange(n), names, 14).shape for n in (1, 2, 3, 4)]
    assert len({rows[i + 1][0] - rows[i][0] for i in range(3)}) == 1  # each class adds one line
    assert rows[3][1] > rows[2][1]  # as wide as the longest name


def test_class_without_a_name_is_refused():
    image, labels = two_halves()
    with pytest.raises(ValueError, match=tells("names:", "got 2")):
        overlay_labels(image, labels, ["a", "b"])


def test_wrong_overlay_input_is_named():
    image, labels = two_halves()
    with pytest.raises(ValueError, match=tells("labels:", "[H, W]", "H = 20", "got (10, 60)")):
        overlay_labels(image, labels[:10])
    with pytest.raises(ValueError, match=tells("alpha:", "[0, 1]", "got 1.5")):
        overlay_labels(image, labels, alpha=1.5)


@pytest.mark.parametrize("shape", [(4, 6), (4, 6, 3), (4, 6, 4)])
def test_saved_picture_reads_back(tmp_path, shape):
    values = torch.rand(shape, generator=torch.Generator().manual_seed(0)) * 1.2 - 0.1
    save_picture(tmp_path / "deep" / "a.png", values)
    expected = np.round(values.clamp(0, 1).numpy() * 255).astype(np.uint8)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "deep" / "a.png")), expected)
    save_picture(tmp_path / "b.png", expected)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "b.png")), expected)
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["a.png"]


def test_wrong_pictures_are_refused(tmp_path):
    with pytest.raises(ValueError, match=tells("path:", ".png", "got 'a.jpg'")):
        save_picture(tmp_path / "a.jpg", np.zeros((2, 2)))
    with pytest.raises(ValueError, match=tells("picture:", "uint8", "got int64")):
        save_picture(tmp_path / "a.png", torch.zeros(2, 2, dtype=torch.int64))
    with pytest.raises(ValueError, match=tells("picture:", "[H, W]", "got (3, 5, 5)")):
        save_picture(tmp_path / "a.png", torch.zeros(3, 5, 5))
    assert list(tmp_path.iterdir()) == []


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


def test_rows_of_several_shapes_keep_them():
    """A landscape above a portrait: without a width in the middle, with one each row in its own proportions."""
    wide, high = np.full((2, 4, 3), 90, np.uint8), np.full((4, 2, 3), 10, np.uint8)
    sheet = picture_grid([[wide, wide], [high, high]])
    assert sheet.shape == (3 * GAP + 2 + 4, 3 * GAP + 2 * 4, 3)
    assert (sheet[GAP : GAP + 2, GAP : GAP + 4] == 90).all()
    below = sheet[2 * GAP + 2 : 2 * GAP + 6, 2 * GAP + 4 : 2 * GAP + 8, 0]
    assert below.tolist() == [[255, 10, 10, 255]] * 4
    assert picture_grid([[wide], [high]], width=8).shape == (3 * GAP + 4 + 16, 2 * GAP + 8, 3)
    mixed = picture_grid([[wide, high]])[GAP:-GAP, GAP:-GAP, 0]
    assert mixed[:, :4].tolist() == [[255] * 4, [90] * 4, [90] * 4, [255] * 4]


@pytest.mark.parametrize(
    ("rows", "titles", "message"),
    [
        ([], (), ("rows, titles:", "got [0]")),
        ([[np.zeros((2, 2, 3))], []], (), ("rows, titles:", "got [1, 0, 1]")),
        ([[np.zeros((2, 2, 3))]], ("a", "b"), ("rows, titles:", "got [1, 2]")),
        ([[np.zeros((2, 2, 3)), np.zeros((2, 2))]], (), ("rows[0][1]:", "[H, W, 3]", "got (2, 2)")),
    ],
)
def test_what_does_not_fit_is_refused(rows, titles, message):
    with pytest.raises(ValueError, match=tells(*message)):
        picture_grid(rows, titles)
