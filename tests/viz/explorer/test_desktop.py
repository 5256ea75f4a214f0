import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
from cases_desktop import CLOUDS, HEIGHT, changed, clouds, press, shot
from cases_explorer import splat_file
from messages import tells

from kfgs.viz import available, headless
from kfgs.viz.explorer import ExploreOptions, Explorer
from kfgs.viz.explorer.desktop import Desktop, open_window
from kfgs.viz.explorer.meaning import SplatMeaning
from kfgs.viz.explorer.panel import WIDTH
from kfgs.viz.explorer.state import Exploration

pytestmark = pytest.mark.skipif(not available(), reason=headless.probe().reason)


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
    for number, show in enumerate(state.show_choices, start=1):
        press(desktop, str(number))
        assert state.show == show
    press(desktop, str(len(state.show_choices) + 1))
    assert state.show == state.show_choices[-1]


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
    with pytest.raises(RuntimeError, match=tells("explorer:", "got none", "serve(explorer)")):
        open_window(desktop.explorer)
    monkeypatch.setattr("kfgs.viz.explorer.desktop.has_display", lambda: True)
    with pytest.raises(RuntimeError, match=tells("explorer:", "window", "off_screen=False")):
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


def test_with_its_panel_a_window_is_no_larger_than_the_screen(tmp_path):
    semantic, _ = clouds()
    state = Exploration(SplatMeaning(splat_file(semantic)))
    with Explorer(
        state, ExploreOptions(height=90, width=200, style="points", out=tmp_path), off_screen=True
    ) as explorer:
        wide, high = explorer.plotter.render_window.GetScreenSize()
        explorer.plotter.window_size = [wide - 50, high + 80]
        Desktop(explorer)
        assert explorer.plotter.window_size == [wide, high]


WINDOW = """
import os, sys
import numpy as np
from cases_desktop import Exploration, Explorer, ExploreOptions, SplatMeaning, clouds, splat_file
from kfgs.viz.explorer.desktop import open_window

semantic, color = clouds()
explorer = Explorer(Exploration(SplatMeaning(splat_file(semantic)), color), ExploreOptions(height=420, width=600))
interactor, seen = explorer.plotter.iren.interactor, []

def press(*keys):
    for key in keys:
        code = {"slash": "/", "Return": chr(13)}.get(key, key)
        interactor.SetKeyEventInformation(0, 0, code, 0, key)
        interactor.InvokeEvent("KeyPressEvent")
        interactor.InvokeEvent("CharEvent")

def work(*_):
    if not seen:
        seen.append(explorer.screenshot())
        press("slash", *"chair", "Return")
        seen.append(explorer.screenshot())
    press("q")  # again and again: it closes nothing before the window's loop runs

interactor.AddObserver("TimerEvent", work)
interactor.Initialize()
timer = interactor.CreateRepeatingTimer(300)
open_window(explorer)
interactor.DestroyTimer(timer)
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
