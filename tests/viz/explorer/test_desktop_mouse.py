import numpy as np
import pytest
from cases_desktop import CHAIR, CLOUDS, changed, click, drag, place, press, seen, shot

from kfgs.viz import available, headless
from kfgs.viz.explorer.panel import WIDTH

pytestmark = pytest.mark.skipif(not available(), reason=headless.probe().reason)


def test_the_lambda_slider_is_logarithmic(desktop):
    state = desktop.explorer.state
    low, high = state.distance_range
    before = shot(desktop)
    drag(desktop, "lambda", [0.5, 0.3, 0.0])
    assert state.distance == pytest.approx(low)
    assert (state.labels("color") < 0).any()
    after = shot(desktop)
    assert changed(before, after) == (True, True)
    aside = np.s_[:, CLOUDS // 4 : CLOUDS // 2 - 2]  # of the semantic side, right of the legend, which gains "no class"
    assert np.array_equal(before[aside], after[aside])
    drag(desktop, "lambda", [0.0, 0.5])
    assert state.distance == pytest.approx((low * high) ** 0.5, rel=0.05)  # within a pixel of 270


def test_the_gamma_slider_selects_and_needs_a_question(desktop):
    state = desktop.explorer.state
    assert not [one for one in desktop.pane.panel.spots if one.value == "gamma"]
    press(desktop, "slash", *"chair", "Return")
    low, high = state.gamma_range
    counts = []
    for share in (0.0, 0.5, 1.0):
        drag(desktop, "gamma", [0.2, share])
        assert state.gamma == pytest.approx(low + share * (high - low), abs=0.01 * (high - low))
        counts.append(int(state.selected("semantic").sum()))
    assert counts[0] > counts[1] > counts[2] == 0


def test_a_slow_cloud_follows_a_dragged_slider_in_the_end(desktop):
    desktop._took = 1e9  # the last frame took very long
    desktop._applied = float("inf")
    state, given = desktop.explorer.state, desktop.explorer.state.distance
    mouse = desktop.explorer.plotter.iren
    mouse._mouse_left_button_press(*place(desktop, "slider", "lambda", 0.9))
    assert state.distance == given
    assert desktop.view().sliders[1].value > given  # the handle and its number do
    mouse._mouse_left_button_release()
    assert state.distance == pytest.approx(desktop.view().sliders[1].value)
    assert state.distance > given


def test_class_boxes_hide_and_names_ask(desktop):
    state = desktop.explorer.state
    before = shot(desktop)
    click(desktop, "box", CHAIR)
    assert state.hidden == {CHAIR}
    assert changed(before, shot(desktop)) == (True, True)
    click(desktop, "box", CHAIR)
    assert state.hidden == frozenset()
    assert np.array_equal(shot(desktop), before)
    click(desktop, "all", False)
    assert {0, 1, 2, 3} <= state.hidden
    click(desktop, "all", True)
    assert state.hidden == frozenset()
    click(desktop, "name", CHAIR)
    assert state.asked.words == "chair"


def test_buttons_choose_show_and_style(desktop):
    click(desktop, "show", "score")
    assert desktop.explorer.state.show == "score"
    click(desktop, "style", "gaussians")
    assert desktop.explorer.style == "gaussians"


def test_buttons_save_the_picture_without_the_panel_and_the_selection(desktop):
    from PIL import Image

    out = desktop.explorer.options.out
    click(desktop, "do", "save selection")
    assert "ValueError" in desktop.error  # nothing is selected yet
    press(desktop, "slash", *"chair", "Return")
    before = shot(desktop)
    click(desktop, "do", "save picture")
    picture = np.asarray(Image.open(next(out.glob("*.png"))))
    assert picture.shape == before.shape
    assert (picture[:, CLOUDS:] == 255).all(-1).mean() > 0.5  # paper of the clouds, not of the panel
    click(desktop, "do", "save selection")
    assert desktop.error == ""
    assert "saved" in desktop.note
    assert next(out.rglob("selection.json")).is_file()
    desktop.call(lambda: None)
    assert np.array_equal(shot(desktop), before)


def test_a_click_picks_and_a_drag_turns(desktop):
    plotter, state = desktop.explorer.plotter, desktop.explorer.state
    x, y = seen(desktop, 5)
    camera = plotter.camera.position
    plotter.iren._mouse_left_button_press(x, y)
    plotter.iren._mouse_move(x + 40, y + 15)
    plotter.iren._mouse_left_button_release()
    assert state.picked is None
    assert plotter.camera.position != camera
    click(desktop, "do", "reset view")
    assert plotter.camera.position == pytest.approx(camera)
    plotter.iren._mouse_left_button_click(*seen(desktop, 5))
    assert state.picked.side == "semantic"
    assert state.picked.label == int(state.labels("semantic")[5])
    assert any(line in desktop.view().lines for line in state.picked.lines())
    plotter.iren._mouse_left_button_click(5, 5)
    assert state.picked is None
    assert desktop.note == "nothing there to pick"


def test_the_mouse_over_the_panel_does_not_move_the_clouds(desktop):
    plotter = desktop.explorer.plotter
    camera = plotter.camera.position
    x, y = place(desktop, "box", 0)
    for button in ("middle", "right"):
        getattr(plotter.iren, f"_mouse_{button}_button_press")(x, y)
        plotter.iren._mouse_move(x + 40, y + 20)
        getattr(plotter.iren, f"_mouse_{button}_button_release")()
    plotter.iren.interactor.MouseWheelForwardEvent()
    assert plotter.camera.position == camera
    plotter.iren._mouse_move(60, 60)
    plotter.iren.interactor.MouseWheelForwardEvent()
    assert plotter.camera.position != camera


def test_the_panel_keeps_its_width_when_the_window_changes(desktop):
    plotter = desktop.explorer.plotter
    for width, height in ((700, 360), (1000, 500)):
        plotter.window_size = [width, height]
        plotter.render()
        picture = shot(desktop)
        assert picture.shape == (height, width, 3)
        assert np.array_equal(picture[:, -WIDTH:], desktop.pane.panel.picture)
        right = plotter.renderers[1].GetViewport()[2] * width
        assert right == pytest.approx(width - WIDTH)
        click(desktop, "show", "score" if desktop.explorer.state.show == "labels" else "labels")
    assert desktop.explorer.state.show == "labels"
