import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
import torch
from cases_explorer import NAMES, cloud, splat_file

from kfgs.viz import available, headless
from kfgs.viz.explorer import ExploreOptions, Explorer
from kfgs.viz.explorer.desktop import Desktop, open_window
from kfgs.viz.explorer.exploration import Exploration
from kfgs.viz.explorer.meaning import SplatMeaning
from kfgs.viz.explorer.panel import WIDTH

pytestmark = pytest.mark.skipif(not available(), reason=headless.probe().reason)

HEIGHT, CLOUDS = 420, 600  # pixels: of the window, and what the two clouds have of its width
CHAIR = NAMES.index("chair")


def clouds():
    """Four classes in the corners of a square; the colour cloud the same, 0.1 aside."""
    generator = torch.Generator().manual_seed(0)
    labels = torch.arange(80) % 4
    corners = torch.tensor([[0.0, 0, 0], [4, 0, 0], [0, 4, 0], [4, 4, 0]])
    means = corners[labels] + 0.2 * torch.randn(80, 3, generator=generator)
    semantic = cloud(means, labels, scales=torch.full((80, 3), 0.15))
    color = cloud(means + torch.tensor([0.1, 0, 0]), sh=torch.rand(80, 1, 3, generator=generator) - 0.5)
    return semantic, color.replace(scales=torch.full((80, 3), 0.15))


@pytest.fixture
def desktop(tmp_path):
    semantic, color = clouds()
    state = Exploration(SplatMeaning(splat_file(semantic, np.linspace(0.1, 0.9, 80, dtype=np.float32))), color)
    options = ExploreOptions(height=HEIGHT, width=CLOUDS, style="points", out=tmp_path)
    with Explorer(state, options, off_screen=True) as explorer:
        window = Desktop(explorer)
        explorer.plotter.show(interactive=False, auto_close=False)
        yield window


def press(desktop, *keys):
    """Keys by their X names, as VTK's interactor sends them: first the key, then the character."""
    interactor = desktop.explorer.plotter.iren.interactor
    codes = {"slash": "/", "Return": "\r", "Escape": "\x1b", "BackSpace": "\b", "Tab": "\t", "space": " "}
    for key in keys:
        interactor.SetKeyEventInformation(0, 0, codes.get(key, key if len(key) == 1 else "\0"), 0, key)
        interactor.InvokeEvent("KeyPressEvent")
        interactor.InvokeEvent("CharEvent")


def spot(desktop, kind, value=None):
    return next(one for one in desktop.pane.panel.spots if (one.kind, one.value) == (kind, value))


def place(desktop, kind, value=None, share=0.5):
    """Window pixels, y from below, of something in the panel."""
    left, top, right, bottom = spot(desktop, kind, value).box
    width, height = desktop.explorer.plotter.window_size
    x = left + round(share * (right - 1 - left))
    return width - WIDTH + x, height - 1 - (top + bottom) // 2


def click(desktop, kind, value=None):
    desktop.explorer.plotter.iren._mouse_left_button_click(*place(desktop, kind, value))


def shot(desktop):
    return desktop.explorer.screenshot().astype(np.int64)


def changed(before, after):
    """Whether the clouds' side of the window and the panel's differ."""
    differs = (before != after).any(-1)
    return bool(differs[:, :CLOUDS].any()), bool(differs[:, CLOUDS:].any())


def test_opening_asks_nothing_and_the_panel_lies_beside_the_clouds(desktop):
    state = desktop.explorer.state
    assert (state.asked, state.gamma, state.hidden, state.picked, state.show) == (
        None,
        None,
        frozenset(),
        None,
        "labels",
    )
    picture = shot(desktop)
    assert picture.shape == (HEIGHT, CLOUDS + WIDTH, 3)
    assert np.array_equal(picture[:, CLOUDS:], desktop.pane.panel.picture)
    for left in (0, CLOUDS // 2):  # both clouds are there, away from the edges
        middle = picture[HEIGHT // 4 : -HEIGHT // 4, left + 30 : left + CLOUDS // 2 - 30]
        assert (middle != 255).any(-1).mean() > 0.01


def test_a_question_is_typed_completed_and_asked(desktop):
    before = shot(desktop)
    press(desktop, "slash", "c", "h")
    assert desktop.line.text == "ch"
    assert desktop.view().hint == "air"
    typing = shot(desktop)
    assert changed(before, typing) == (False, True)
    press(desktop, "Tab", "Return")
    assert desktop.line is None
    assert desktop.explorer.state.asked.words == "chair"
    assert changed(typing, shot(desktop)) == (True, True)
    press(desktop, "Escape")
    assert desktop.explorer.state.asked is None
    assert np.array_equal(shot(desktop), before)


def test_while_typing_no_key_of_vtk_or_pyvista_acts(desktop):
    plotter, heard = desktop.explorer.plotter, []
    for key in ("q", "w", "v", "Up", "plus"):
        plotter.add_key_event(key, lambda key=key: heard.append(key))
    plotter.iren.interactor.AddObserver("CharEvent", lambda *_: heard.append("character"), -1.0)
    camera = plotter.camera.position
    press(desktop, "slash", "q", "e", "w", "s", "p", "r", "v", "3", "Up", "plus")
    assert desktop.line.text == "qewsprv3"
    assert heard == []
    assert plotter.camera.position == camera
    assert not list(desktop.explorer.options.out.iterdir())  # p and s would have saved
    press(desktop, "BackSpace", "BackSpace", "Escape", "w", "v", "e")
    assert desktop.line is None
    assert heard == []  # nor later, but for q, which closes
    press(desktop, "q")
    assert heard == ["q", "character"]


def test_an_unknown_word_is_said_and_nothing_is_raised(desktop, capfd):
    press(desktop, "slash", "c", "h", "a", "i", "r", "Return", "slash", "z", "o", "o", "Return")
    assert desktop.explorer.state.asked.words == "chair"
    assert "expected one of" in desktop.error
    assert "zoo" in desktop.error
    press(desktop, "2")
    assert desktop.error == ""
    assert capfd.readouterr() == ("", "")


def test_keys_choose_what_colours_stand_for(desktop):
    state = desktop.explorer.state
    for number, show in enumerate(state.shows, start=1):
        press(desktop, str(number))
        assert state.show == show
    press(desktop, str(len(state.shows) + 1))
    assert state.show == state.shows[-1]


def drag(desktop, name, shares):
    mouse = desktop.explorer.plotter.iren
    mouse._mouse_left_button_press(*place(desktop, "slider", name, shares[0]))
    for share in shares[1:]:
        mouse._mouse_move(*place(desktop, "slider", name, share))
    mouse._mouse_left_button_release()


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


def seen(desktop, index):
    """Window pixels, y from below, of a semantic Gaussian."""
    renderer = desktop.explorer.plotter.renderers[0]
    x, y, z = desktop.explorer.state.cloud("semantic").means[index].tolist()
    renderer.SetWorldPoint(x, y, z, 1.0)
    renderer.WorldToDisplay()
    return tuple(round(v) for v in renderer.GetDisplayPoint()[:2])


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


def test_a_verb_from_outside_is_shown(desktop):
    before = shot(desktop)
    desktop.explorer.ask("table")
    assert changed(before, shot(desktop)) == (True, True)
    assert desktop.view().question == "table"


def test_after_the_window_the_explorer_draws_off_screen_without_a_panel(desktop):
    explorer = desktop.explorer
    desktop.leave()
    explorer.ask("chair")
    picture = explorer.screenshot()
    assert picture.shape == (HEIGHT, CLOUDS, 3)
    assert explorer.plotter.renderers[1].GetViewport() == (0.5, 0.0, 1.0, 1.0)
    assert (picture[:, CLOUDS // 2 :] != 255).any()


def test_a_window_needs_a_display(desktop, monkeypatch):
    monkeypatch.setattr("kfgs.viz.explorer.desktop.has_display", lambda: False)
    with pytest.raises(RuntimeError, match=r"explorer: expected a display to open a window on, got none .*; use serve"):
        open_window(desktop.explorer)
    monkeypatch.setattr("kfgs.viz.explorer.desktop.has_display", lambda: True)
    with pytest.raises(
        RuntimeError, match=r"expected one that draws into a window, got one that draws off-screen; make"
    ):
        open_window(desktop.explorer)


def test_one_cloud_alone_has_no_lambda(tmp_path):
    semantic, _ = clouds()
    options = ExploreOptions(height=HEIGHT, width=CLOUDS, style="points", out=tmp_path)
    with Explorer(Exploration(SplatMeaning(splat_file(semantic))), options, off_screen=True) as explorer:
        desktop = Desktop(explorer)
        explorer.plotter.show(interactive=False, auto_close=False)
        press(desktop, "slash", *"chair", "Return")
        assert [one.value for one in desktop.pane.panel.spots if one.kind == "slider"] == ["gamma"]
        assert shot(desktop).shape == (HEIGHT, CLOUDS // 2 + WIDTH, 3)


WINDOW = """
import os, sys
import numpy as np
sys.path.insert(0, os.path.join("tests", "viz", "explorer"))
from test_desktop import Exploration, Explorer, ExploreOptions, SplatMeaning, clouds, open_window, splat_file

semantic, color = clouds()
explorer = Explorer(Exploration(SplatMeaning(splat_file(semantic)), color), ExploreOptions(height=420, width=600))
interactor, seen = explorer.plotter.iren.interactor, []

def work(*_):
    if not seen:
        seen.append(explorer.screenshot())
        for key in ("slash", *"chair", "Return", "q"):
            code = {"slash": "/", "Return": chr(13)}.get(key, key)
            interactor.SetKeyEventInformation(0, 0, code, 0, key)
            interactor.InvokeEvent("KeyPressEvent")
            interactor.InvokeEvent("CharEvent")
        seen.append(explorer.screenshot())

interactor.AddObserver("TimerEvent", work)
interactor.Initialize()
interactor.CreateOneShotTimer(300)
open_window(explorer)
first, asked = seen
assert explorer.state.asked.words == "chair"
assert (first[:, :600] != asked[:, :600]).any() and (first[:, 600:] != asked[:, 600:]).any()
explorer.ask("table")
after = explorer.screenshot()
assert after.shape == (420, 600, 3) and after.std() > 0
explorer.close()
print("closed")
"""


@pytest.mark.skipif(shutil.which("Xvfb") is None, reason="a real window needs Xvfb")
def test_a_real_window_opens_answers_and_closes():
    command = ["Xvfb", "-displayfd", "1", "-screen", "0", "1280x800x24"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as server:
        try:
            environment = {name: value for name, value in os.environ.items() if name not in headless.WITHOUT_DISPLAY}
            paths = os.pathsep.join(["tests", *filter(None, [os.environ.get("PYTHONPATH")])])
            done = subprocess.run(
                [sys.executable, "-W", "error", "-c", WINDOW], capture_output=True, text=True, check=False, timeout=120,
                env=environment | {"DISPLAY": f":{server.stdout.readline().strip()}", "PYTHONPATH": paths},
                cwd=os.path.join(os.path.dirname(__file__), *[os.pardir] * 3),
            )  # fmt: skip
        finally:
            server.terminate()
    assert (done.returncode, done.stdout, done.stderr) == (0, "closed\n", "")
