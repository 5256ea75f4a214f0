from math import isclose, sqrt

import numpy as np
import pytest

from kfgs.viz import palette
from kfgs.viz.explorer.panel import CHOSEN, LINE, MARGIN, PAPER, PanelView, Slider, draw_panel

NAMES = [f"class {i}" for i in range(60)]


def classes(count):
    return [*enumerate(NAMES[:count]), (-1, "no class")]


def full(count=6, **changes):
    parts = {
        "sliders": (Slider("gamma", 0.25, 0, 1), Slider("lambda", 0.1, 0.01, 1, logarithmic=True)),
        "choices": (("show", ("labels", "rgb", "score"), "rgb"),),
        "actions": ("save picture", "save selection", "reset view"),
        "classes": classes(count),
        "lines": ("'chair': score > 0.25", "semantic: 3 of 9 Gaussians"),
        "keys": ("/ ask",),
    }
    return PanelView(**(parts | changes))


def test_a_linear_slider_by_hand():
    slider = Slider("gamma", 0.0, -1.0, 3.0)
    assert slider.share(0.0) == 0.25
    assert slider.at(0.75) == 2.0
    assert slider.at(-0.1) == -1.0
    assert slider.at(1.1) == 3.0


def test_the_middle_of_a_logarithmic_slider_is_the_geometric_mean():
    slider = Slider("lambda", 0.1, 1e-3, 7.0, logarithmic=True)
    assert isclose(slider.at(0.5), sqrt(1e-3 * 7.0))
    assert isclose(slider.share(sqrt(1e-3 * 7.0)), 0.5)
    assert slider.at(1.0) <= 7.0
    assert slider.at(0.0) >= 1e-3


@pytest.mark.parametrize("logarithmic", [False, True])
def test_share_and_value_are_inverse(logarithmic):
    slider = Slider("x", 1.0, 0.3, 17.0, logarithmic)
    for share in np.linspace(0, 1, 11):
        assert isclose(slider.share(slider.at(share)), share, abs_tol=1e-12)


def test_a_slider_without_room_stays():
    slider = Slider("gamma", 2.0, 2.0, 2.0)
    assert slider.share(2.0) == 0.0
    assert slider.at(0.7) == 2.0


@pytest.mark.parametrize("count", [1, 6, 20, 59])
@pytest.mark.parametrize("height", [320, 600])
def test_spots_lie_inside_and_do_not_overlap(count, height):
    panel = draw_panel(full(count), height, 300)
    assert panel.picture.shape == (height, 300, 3)
    hits = np.zeros((height, 300), dtype=int)
    for spot in panel.spots:
        left, top, right, bottom = spot.box
        assert 0 <= left < right <= 300
        assert 0 <= top < bottom <= height
        hits[top:bottom, left:right] += 1
    assert hits.max() == 1


@pytest.mark.parametrize("count", [6, 20, 59])
def test_every_class_can_be_reached_by_scrolling(count):
    last = draw_panel(full(count), 500).last_scroll
    boxes, names = set(), set()
    for scroll in range(last + 1):
        panel = draw_panel(full(count, scroll=scroll), 500)
        boxes |= {spot.value for spot in panel.spots if spot.kind == "box"}
        names |= {spot.value for spot in panel.spots if spot.kind == "name"}
    assert boxes == {-1, *range(count)}
    assert names == set(range(count))  # nobody can be asked for what has no class
    assert (last == 0) == (count == 6)
    beyond = draw_panel(full(count, scroll=last + 9), 500)
    assert np.array_equal(beyond.picture, draw_panel(full(count, scroll=last), 500).picture)


def test_a_box_has_its_classes_colour_and_hiding_empties_it():
    for hidden in (frozenset(), frozenset({2})):
        panel = draw_panel(full(hidden=hidden), 600)
        left, top, right, bottom = next(s.box for s in panel.spots if s.kind == "box" and s.value == 2)
        inside = (panel.picture[top:bottom, left:right] == palette(np.array(2))).all(-1).mean()
        assert (inside > 0.25) == (not hidden)  # filled but for edge and tick, or a small square
        assert inside > 0.1


def test_the_handle_is_where_the_value_is():
    panel = draw_panel(full(), 600)
    for name, share in (("gamma", 0.25), ("lambda", 0.5)):
        left, top, right, _ = next(s.box for s in panel.spots if s.value == name)
        row = (panel.picture[top + 6, left:right] == CHOSEN).all(-1).nonzero()[0]  # above the bar only the handle
        assert abs(row.mean() - share * (right - 1 - left)) < 1


def test_without_a_value_a_slider_cannot_be_dragged():
    panel = draw_panel(full(sliders=(Slider("gamma", None, 0, 1),)), 600)
    assert not [spot for spot in panel.spots if spot.kind == "slider"]


def test_find_tells_what_lies_at_a_point():
    panel = draw_panel(full(), 600)
    for spot in panel.spots:
        left, top, right, bottom = spot.box
        assert panel.find(left, top) == spot
        assert panel.find(right - 0.5, bottom - 0.5) == spot
    assert panel.find(1, 1) is None


def test_the_error_is_said_last_and_outlives_a_small_panel():
    base = draw_panel(full(40, lines=["word " * 60]), 360).picture
    with_error = draw_panel(full(40, lines=["word " * 60], error="ValueError: no such class"), 360).picture
    red = (with_error[..., 0].astype(int) - with_error[..., 2] > 60) & (with_error[..., 1] < 100)
    assert red[-MARGIN - 2 * LINE - 4 :].sum() > 20
    assert not np.array_equal(base, with_error)


def test_long_words_are_cut_and_long_lines_wrapped():
    words = "a sentence that is much too long for one line of a narrow panel " + "x" * 300
    panel = draw_panel(full(lines=[words]), 600)
    edge = panel.picture[:, -MARGIN // 2 :]
    assert (edge == PAPER).all()  # nothing runs out of the panel
