import numpy as np
import pytest
import torch
from cases_viz import some_gaussians, some_plotter
from kfgs.viz.cloud_colors import cloud_colors
from matplotlib import colormaps
from messages import tells
from oracles_palette import linear

from kfgs.labels import LabelSet
from kfgs.viz import add_cloud, add_legend, add_scalar_bar, palette
from kfgs.viz.legends import bar_picture, letter_size, pin_picture, round_numbers
from kfgs.viz.pictures import legend_column

NAMES = [f"class {i}" for i in range(18)]
WHITE = np.array([255, 255, 255])


@pytest.fixture
def plotter():
    with some_plotter() as plotter:
        yield plotter


def paper(plotter):  # rows and columns that a picture covers, over a black background
    picture = plotter.screenshot(return_img=True)
    rows, columns = np.nonzero((picture == WHITE).all(axis=-1))
    return picture, (rows.min(), rows.max() + 1, columns.min(), columns.max() + 1)


def colors_in(picture, labels):
    return [bool((picture.reshape(-1, 3) == palette(np.array(label), NAMES)).all(axis=1).any()) for label in labels]


def test_legend_is_drawn_as_it_is_in_the_lower_left_corner(plotter):
    labels, names = torch.tensor([2, -1, 0, 2]), ["wall", "floor", "rug"]
    add_legend(plotter, labels, names)
    expected = legend_column(labels, names)
    height, width, _ = expected.shape
    picture = plotter.screenshot(return_img=True)
    np.testing.assert_array_equal(picture[120 - 10 - height : 120 - 10, 10 : 10 + width], expected)
    assert not picture[: 120 - 10 - height].any()
    with pytest.raises(ValueError, match=tells("names:", "got 1")):
        add_legend(plotter, np.array([5]), ["wall"])
    with pytest.raises(ValueError, match=tells("labels:", "got none")):
        add_legend(plotter, np.zeros(0, dtype=int), ["wall"])
    with pytest.raises(TypeError, match=tells("names:", "got LabelSet", ".names")):
        add_legend(plotter, labels, LabelSet(("wall", "floor"), torch.eye(2)))


def test_legend_of_many_classes_fits_a_low_window(plotter):
    add_legend(plotter, np.arange(10), NAMES)
    picture, (top, bottom, left, _) = paper(plotter)
    assert (bottom, left) == (110, 10)
    assert top >= 10
    assert all(colors_in(picture, range(10)))
    assert not any(colors_in(picture, range(10, 18)))


def test_column_of_bounded_height_goes_on_beside_itself():
    one, wrapped = legend_column(np.arange(5), NAMES, 10), legend_column(np.arange(5), NAMES, 10, height=60)
    assert wrapped.shape[0] <= 60 < one.shape[0]
    assert 2 * one.shape[1] - 10 <= wrapped.shape[1] <= 2 * one.shape[1]
    assert all(colors_in(wrapped, range(5)))
    three = legend_column(np.arange(3), NAMES, 10)
    np.testing.assert_array_equal(wrapped[: len(three) - 5, : three.shape[1]], three[: len(three) - 5])
    np.testing.assert_array_equal(legend_column(np.arange(5), NAMES, 10, height=len(one)), one)


def test_picture_follows_the_size_of_its_subplot(plotter):
    sizes = []

    def draw(height, width):
        sizes.append((height, width))
        return np.full((height // 4, width // 2, 3), 255, np.uint8)

    pin_picture(plotter, draw, "right")
    assert paper(plotter)[1] == (120 - 10 - 30, 110, 160 - 10 - 80, 150)
    plotter.render()
    plotter.window_size = [200, 200]
    plotter.render()
    assert paper(plotter)[1] == (200 - 10 - 50, 190, 200 - 10 - 100, 190)
    assert sizes == [(120, 160), (200, 200)]


def test_picture_that_was_removed_is_not_drawn_again(plotter):
    sizes = []
    actor = pin_picture(
        plotter, lambda height, width: (sizes.append(height), np.full((20, 20, 3), 255, np.uint8))[1], "left"
    )
    assert plotter.screenshot(return_img=True).any()
    plotter.remove_actor(actor)
    plotter.window_size = [200, 200]
    plotter.render()
    assert not plotter.screenshot(return_img=True).any()
    assert sizes == [120]


def test_scalar_bar_stands_in_the_lower_right_corner_with_the_colours_of_its_scale(plotter):
    cloud = add_cloud(plotter, some_gaussians(), color_by="opacity")
    cloud.SetVisibility(False)
    bar = add_scalar_bar(plotter, cloud, "opacity")
    expected = bar_picture((0, 1), "opacity", 120, 160)
    height, width, _ = expected.shape
    picture = plotter.screenshot(return_img=True)
    np.testing.assert_array_equal(picture[110 - height : 110, 150 - width : 150], expected)
    plotter.remove_actor(bar)
    add_scalar_bar(plotter, (0.0, 1.0), "opacity")
    plotter.render()
    np.testing.assert_array_equal(plotter.screenshot(return_img=True), picture)
    with pytest.raises(ValueError, match=tells("cloud:", "coloured")):
        add_scalar_bar(plotter, add_cloud(plotter, some_gaussians()))
    with pytest.raises(ValueError, match=tells("(1, inf)", "got 0")):
        add_scalar_bar(plotter, [1, 0])


def test_what_holds_gaussians_is_not_taken_for_them(plotter):
    splats = some_gaussians()
    with pytest.raises(TypeError, match=tells("gaussians:", "got SplatFile", ".gaussians")):
        cloud_colors(splats, "label")


def test_bar_grows_from_the_darkest_to_the_brightest_colour():
    picture = bar_picture((-2.0, 3.0), "cosine", 400, 600)
    column = picture[:, letter_size(400) // 2 + 3]
    rows = np.flatnonzero((column != WHITE).any(axis=1) & (np.abs(np.diff(column.astype(int), axis=1)).max(axis=1) > 3))
    bar = column[rows[0] : rows[-1] + 1]
    ends = (colormaps["cividis"]([1.0, 0.0]) * 255).round()[:, :3]
    np.testing.assert_allclose(bar[[0, -1]], ends, atol=1)
    luminance = linear(bar / 255) @ np.array([0.2126, 0.7152, 0.0722])
    assert (np.diff(luminance) <= 2e-3).all()  # but for the rounding of bytes


def test_long_title_is_broken_and_makes_no_bar_wider_than_its_words():
    short, long = (bar_picture((0, 1), title, 400, 600) for title in ("score", "score of a dark green plant"))
    assert long.shape[1] <= short.shape[1] + 600 / 5
    assert long.shape[0] == short.shape[0]  # the bar gives way


def test_numbers_beside_the_bar_are_round():
    assert round_numbers(0, 1) == pytest.approx([0, 0.2, 0.4, 0.6, 0.8, 1])
    assert round_numbers(0.0098, 0.99) == pytest.approx([0.2, 0.4, 0.6, 0.8])
    assert round_numbers(-2, 3) == pytest.approx([-2, -1, 0, 1, 2, 3])
    for low, high in ((0.123, 0.124), (-7e5, 3e6), (0.5, 0.50001)):
        numbers = round_numbers(low, high)
        assert 3 <= len(numbers) <= 6
        assert low <= numbers[0] < numbers[-1] <= high


def test_letters_grow_with_large_windows_only():
    assert [letter_size(height) for height in (100, 480, 768, 1100, 2200)] == [14, 14, 14, 20, 40]
