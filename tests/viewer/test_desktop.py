import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
from cases_desktop import HEIGHT, WIDTH, clouds, drag, press, seen, shot
from cases_explorer import splat_file
from kfgs.viewer.desktop import Desktop, open_window
from messages import tells
from PIL import Image

from kfgs.viewer import ExploreOptions, Explorer
from kfgs.viewer.meaning import SplatMeaning
from kfgs.viewer.state import Exploration
from kfgs.viz import available, headless

pytestmark = pytest.mark.skipif(not available(), reason=headless.probe().reason)


def test_keys_go_through_the_classes(desktop):
    state, asked = desktop.explorer.state, []
    for key in ("n", "n", "N", "N", "N", "n", "Escape", "N"):
        press(desktop, key)
        asked.append(state.asked and state.asked.words)
    assert asked == ["wall", "chair", "wall", "office chair", "table", "office chair", None, "office chair"]
    assert desktop.text.input.startswith("'office chair': score >")


def test_keys_hide_and_show_classes(desktop):
    state, before = desktop.explorer.state, shot(desktop)
    press(desktop, "h")
    assert state.hidden == frozenset()  # there is no question
    press(desktop, "n", "h", "n", "h")
    assert state.hidden == {0, 1}
    assert (shot(desktop) != before).any()
    press(desktop, "H", "Escape")
    above = np.s_[:320]  # no sliders, whose edges may round otherwise
    np.testing.assert_allclose(shot(desktop)[above], before[above], atol=1)


def test_keys_choose_colours_and_style(desktop):
    state = desktop.explorer.state
    for number, show in enumerate(state.show_choices, start=1):
        press(desktop, str(number))
        assert state.show == show
    press(desktop, str(len(state.show_choices) + 1))
    assert state.show == state.show_choices[-1]
    press(desktop, "g")
    assert desktop.explorer.style == "gaussians"


def test_keys_of_vtk_do_nothing_but_q(desktop):
    heard, camera = [], desktop.plotter.camera.position
    desktop.plotter.iren.interactor.AddObserver("CharEvent", lambda *_: heard.append("character"), -1.0)
    press(desktop, "w", "3", "e", "v", "C", "b")
    assert heard == []
    assert desktop.plotter.camera.position == camera
    press(desktop, "q")
    assert heard == ["character"]


def test_the_list_of_keys_comes_and_goes(desktop):
    before = shot(desktop)
    press(desktop, "k")
    assert "n, N  next, previous class" in desktop.text.input
    assert "1  labels    2  rgb" in desktop.text.input
    assert (shot(desktop) != before).any()
    press(desktop, "k")
    assert np.array_equal(shot(desktop), before)


def test_the_lambda_slider_is_logarithmic(desktop):
    state = desktop.explorer.state
    low, high = state.distance_range
    drag(desktop, "lambda", 0.0)
    assert state.distance == pytest.approx(low)
    assert (state.labels("color") < 0).any()
    drag(desktop, "lambda", 0.5)
    assert state.distance == pytest.approx((low * high) ** 0.5, rel=0.1)  # within a pixel of 135
    assert desktop.sliders["lambda"].GetRepresentation().GetTitleText() == f"lambda {state.distance:.3g}"


def test_the_gamma_slider_selects_and_needs_a_question(desktop):
    state, slider = desktop.explorer.state, desktop.sliders["gamma"]
    assert not slider.GetRepresentation().GetVisibility()
    press(desktop, "n", "n")
    assert slider.GetRepresentation().GetVisibility()
    low, high = state.gamma_range
    counts = []
    for share in (0.0, 0.5, 1.0):
        drag(desktop, "gamma", share)
        assert state.gamma == pytest.approx(low + share * (high - low), abs=0.02 * (high - low))
        counts.append(int(state.selected("semantic").sum()))
    assert counts[0] > counts[1] > counts[2] == 0


def test_a_click_picks_and_a_drag_turns(desktop):
    mouse, state, camera = desktop.plotter.iren, desktop.explorer.state, desktop.plotter.camera.position
    x, y = seen(desktop, 5)
    mouse._mouse_left_button_press(x, y)
    mouse._mouse_move(x + 40, y + 15)
    mouse._mouse_left_button_release()
    assert state.picked is None
    assert desktop.plotter.camera.position != camera
    press(desktop, "r")
    assert desktop.plotter.camera.position == pytest.approx(camera)
    mouse._mouse_left_button_click(*seen(desktop, 5))
    assert (state.picked.side, state.picked.label) == ("semantic", int(state.labels("semantic")[5]))
    assert state.picked.lines()[0] in desktop.text.input
    mouse._mouse_left_button_click(5, HEIGHT - 5)
    assert state.picked is None
    assert "nothing there to pick" in desktop.text.input


def test_keys_save_the_picture_without_controls_and_the_selection(desktop, capfd):
    out = desktop.explorer.options.out
    press(desktop, "s")
    assert "ValueError" in desktop.note  # nothing is selected yet
    press(desktop, "n", "p")
    assert desktop.note == f"saved {out / 'picture_001.png'}"
    saved = np.asarray(Image.open(out / "picture_001.png"))
    assert saved.shape == (HEIGHT, WIDTH, 3)
    assert (saved != shot(desktop)).any()
    press(desktop, "s")
    assert desktop.note == f"saved {out / 'selection_001'}"
    assert (out / "selection_001" / "selection.json").is_file()
    desktop.leave()
    np.testing.assert_allclose(desktop.explorer.screenshot(), saved, atol=1)
    assert capfd.readouterr() == ("", "")


def test_what_a_program_changes_is_shown(desktop):
    before = shot(desktop)
    desktop.explorer.ask("table")
    assert desktop.text.input.startswith("'table'")
    assert (shot(desktop) != before).any()


def test_a_window_needs_a_display(desktop, monkeypatch):
    monkeypatch.setattr("kfgs.viewer.desktop.has_display", lambda: False)
    with pytest.raises(RuntimeError, match=tells("explorer:", "got none", "browser")):
        open_window(desktop.explorer)
    monkeypatch.setattr("kfgs.viewer.desktop.has_display", lambda: True)
    with pytest.raises(RuntimeError, match=tells("explorer:", "window", "off_screen=False")):
        open_window(desktop.explorer)


def test_one_cloud_alone_has_no_lambda(tmp_path):
    semantic, _ = clouds()
    options = ExploreOptions(height=HEIGHT, width=WIDTH, style="points", out=tmp_path)
    with Explorer(Exploration(SplatMeaning(splat_file(semantic))), options, off_screen=True) as explorer:
        assert list(Desktop(explorer).sliders) == ["gamma"]


WINDOW = """
import os, sys
import numpy as np
from cases_desktop import Exploration, Explorer, ExploreOptions, SplatMeaning, clouds, splat_file
from kfgs.viewer.desktop import open_window

semantic, color = clouds()
explorer = Explorer(Exploration(SplatMeaning(splat_file(semantic)), color), ExploreOptions(height=420, width=600))
interactor, seen = explorer.plotter.iren.interactor, []

def press(key):
    interactor.SetKeyEventInformation(0, 0, key, 0, key)
    interactor.InvokeEvent("KeyPressEvent")
    interactor.InvokeEvent("CharEvent")

def work(*_):
    if not seen:
        seen.append(explorer.screenshot())
        press("n")
        seen.append(explorer.screenshot())
    press("q")  # again and again: it closes nothing before the window's loop runs

interactor.AddObserver("TimerEvent", work)
interactor.Initialize()
timer = interactor.CreateRepeatingTimer(300)
open_window(explorer)
interactor.DestroyTimer(timer)
first, asked = seen
assert explorer.state.asked.words == "wall"
assert (first[:, :300] != asked[:, :300]).any() and (first[:, 300:] != asked[:, 300:]).any()
explorer.ask("table")
after = explorer.screenshot()
assert after.shape == (420, 600, 3) and after.std() > 0
explorer.close()
print("closed")
"""


@pytest.mark.skipif(shutil.which("Xvfb") is None, reason="a real window needs Xvfb")
def test_a_real_window_opens_answers_and_closes():
    # Without -noreset the server starts anew whenever its last client leaves, and refuses a client that comes meanwhile.
    command = ["Xvfb", "-displayfd", "1", "-noreset", "-screen", "0", "1280x800x24"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as server:
        try:
            environment = {name: value for name, value in os.environ.items() if name not in headless.WITHOUT_DISPLAY}
            paths = os.pathsep.join(["tests", *filter(None, [os.environ.get("PYTHONPATH")])])
            done = subprocess.run(
                [sys.executable, "-W", "error", "-c", WINDOW], capture_output=True, text=True, check=False, timeout=600,
                env=environment | {"DISPLAY": f":{server.stdout.readline().strip()}", "PYTHONPATH": paths},
                cwd=os.path.join(os.path.dirname(__file__), *[os.pardir] * 3),
            )  # fmt: skip
        finally:
            server.terminate()
    assert (done.returncode, done.stdout, done.stderr) == (0, "closed\n", ""), done.stderr
