import numpy as np
import pytest
import torch
from messages import refused
from PIL import Image

from kfgs.viz import overlay_labels, palette
from kfgs.viz.pictures import GAP, draw_legend, picture_grid, save_picture


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
    refused(lambda: overlay_labels(image, labels, ["a", "b"]), "names:", "got 2")
    refused(lambda: overlay_labels(image, labels[:10]), "labels:", "[H, W]", "H = 20", "got (10, 60)")
    refused(lambda: overlay_labels(image, labels, alpha=1.5), "alpha:", "[0, 1]", "got 1.5")


def test_legend_shows_each_present_class_once_in_its_colour():
    _, labels = two_halves()
    names = [f"class {i}" for i in range(6)]
    strip = draw_legend(labels, names, width=200)
    for label, there in ((-1, True), (0, True), (3, True), (1, False), (2, False)):
        matches = (strip == palette(np.array(label), names)).all(axis=-1).sum()
        assert (matches > 20) == there, label
    image, labels = two_halves(width=200)
    picture = overlay_labels(image, labels, names)
    np.testing.assert_array_equal(picture[20:], strip)
    narrow = draw_legend(labels, names, width=90)
    assert narrow.shape[1] == 90
    assert narrow.shape[0] > strip.shape[0]  # wrapped


@pytest.mark.parametrize("shape", [(4, 6), (4, 6, 3), (4, 6, 4)])
def test_saved_picture_reads_back(tmp_path, shape):
    values = torch.rand(shape, generator=torch.Generator().manual_seed(0)) * 1.2 - 0.1
    save_picture(tmp_path / "deep" / "a.png", values)
    expected = np.round(values.clamp(0, 1).numpy() * 255).astype(np.uint8)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "deep" / "a.png")), expected)
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["a.png"]
    refused(lambda: save_picture(tmp_path / "a.jpg", expected), "path:", ".png", "got 'a.jpg'")


def test_pictures_lie_where_their_row_and_column_say_under_their_titles():
    rows = [[torch.full((10, 60, 3), (2 * i + j) / 4) for j in range(2)] for i in range(2)]
    sheet = picture_grid(rows)
    assert sheet.shape == (GAP + 2 * (10 + GAP), GAP + 2 * (60 + GAP), 3)
    rows_and_columns = [GAP + 5, GAP + 5, 2 * GAP + 15, 0], [GAP + 5, 2 * GAP + 65, GAP + 5, 0]
    assert sheet[rows_and_columns][:, 0].tolist() == [0, 64, 128, 255]
    titled = picture_grid(rows, ["before", ""])
    head = len(titled) - len(sheet) + GAP
    assert (titled[head:] == sheet[GAP:]).all()
    assert titled[:head, : GAP + 60].min() < 100
    assert titled[:head, 2 * GAP + 60 :].min() == 255
    refused(lambda: picture_grid([]), "rows, titles:", "got [0]")
    refused(lambda: picture_grid([rows[0], []]), "rows, titles:", "got [2, 0, 2]")
    refused(lambda: picture_grid(rows[:1], ["a", "b", "c"]), "rows, titles:", "got [2, 3]")
    refused(lambda: picture_grid([[np.zeros((2, 2))]]), "rows[0][0]:", "[H, W, 3]", "got (2, 2)")


def test_a_large_photo_is_averaged_and_keeps_its_proportions():
    photo = np.zeros((6, 4, 3), np.uint8)
    photo[::2, ::2] = 200  # a quarter of every 2 x 2 block
    sheet = picture_grid([[photo]], width=2)
    assert sheet.shape == (GAP + 3 + GAP, GAP + 2 + GAP, 3)
    assert (sheet[GAP : GAP + 3, GAP : GAP + 2] == 50).all()
    coarse = np.arange(18, dtype=np.uint8).reshape(2, 3, 3) * 10  # a map beside its photo repeats pixels
    shown = picture_grid([[np.zeros((8, 12, 3)), coarse]], width=12)[GAP : GAP + 8, 2 * GAP + 12 : 2 * GAP + 24]
    assert (shown == coarse.repeat(4, 0).repeat(4, 1)).all()


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
