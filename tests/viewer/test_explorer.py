from pathlib import Path
from threading import Event, Thread

import numpy as np
import pytest
import torch
from cases_viz import some_camera
from cases_window import LEGEND, SMALL, TITLE, a_state, agreement, an_explorer, panes, psnr
from messages import tells
from PIL import Image

from kfgs.cameras import Distortion
from kfgs.splat.rasterize import rasterize
from kfgs.viewer import ExploreOptions, Explorer

pytestmark = pytest.mark.usefixtures("driver")


def test_a_camera_of_other_proportions_is_seen_whole_and_undistorted():
    wide = some_camera().resized(120, 640)
    square = some_camera()
    K = torch.tensor([[200.0, 0, 150], [0, 200, 70], [0, 0, 1]], dtype=torch.float64)
    wide = type(wide)(square.viewmat, K, 320, 120)
    with an_explorer(camera=wide) as explorer:
        seen = panes(explorer.screenshot() / 255)["color"]
        cloud = explorer.state.cloud("color").replace(sh=None, labels=None)
        colors = torch.from_numpy(explorer.state.colors("color") / 255).float()
        drawn = rasterize(cloud.replace(features=colors), wide.to(torch.float32))
        other = (drawn.map + (1 - drawn.alpha)[..., None]).numpy()
        assert psnr(seen[60:180], other[:, 1:]) > 40


def test_first_view_without_cameras_shows_everything():
    with Explorer(a_state(), ExploreOptions(**SMALL), off_screen=True) as explorer:
        for half in panes(explorer.screenshot()).values():
            assert (half[TITLE:, LEGEND:] < 250).any(axis=2).mean() > 0.05


def test_the_first_of_the_states_cameras_is_looked_through():
    camera = some_camera().resized(240, 320)
    with Explorer(a_state(cameras=[camera]), ExploreOptions(**SMALL), off_screen=True) as explorer:
        assert agreement(explorer, "color") > 45
        explorer.plotter.camera.azimuth += 50
        assert agreement(explorer, "color") < 30
        explorer.reset_view()
        assert agreement(explorer, "color") > 45


def test_one_side_alone_has_one_pane():
    with an_explorer(a_state(1)) as explorer:
        assert explorer.screenshot().shape == (240, 320, 3)
        assert explorer.pick(180, 110).side == "semantic"
        assert explorer.pick(400, 110) is None


def test_listeners_hear_of_each_change(explorer):
    heard = []
    explorer.listen(lambda: heard.append(explorer.state.show))
    explorer.set_show("score")
    explorer.ask("chair")
    explorer.pick(180, 110)
    assert heard == ["score"] * 3
    with pytest.raises(ValueError, match=tells("class:", "got 'chiar'")):
        explorer.ask("chiar")
    assert len(heard) == 3
    assert explorer.state.asked.words == "chair"
    explorer._listeners.clear()


def test_files_are_numbered(tmp_path):
    with an_explorer(out=tmp_path / "view") as explorer:
        assert [explorer.save_picture().name for _ in range(2)] == ["picture_001.png", "picture_002.png"]
        np.testing.assert_array_equal(
            np.asarray(Image.open(tmp_path / "view" / "picture_002.png")), explorer.screenshot()
        )
        with pytest.raises(ValueError, match=tells("selection:", "got none")):
            explorer.save_selection()
        explorer.ask("chair")
        assert {path.parent.name for path in explorer.save_selection()} == {"selection_001"}
        assert {path.parent.name for path in explorer.save_selection()} == {"selection_002"}


def test_in_a_notebook_it_is_a_picture(explorer):
    import io

    picture = np.asarray(Image.open(io.BytesIO(explorer._repr_png_())))
    np.testing.assert_array_equal(picture, explorer.screenshot())


def test_a_verb_draws_no_frame_before_somebody_looks(explorer):
    frames = []
    window = explorer.plotter.render_window
    explorer.screenshot()
    tag = window.AddObserver("StartEvent", lambda *_: frames.append(1))
    for style in ("points", "gaussians"):
        explorer.set_style(style)
        explorer.ask("chair")
        explorer.set_show("score")
        explorer.pick(180, 110)
    assert not frames
    explorer.screenshot()
    window.RemoveObserver(tag)
    assert len(frames) == 1


def test_auto_draws_points_where_there_are_many_gaussians(monkeypatch):
    from kfgs.viewer import explorer as module

    with an_explorer() as few:
        assert few.style == "gaussians"
    monkeypatch.setattr(module, "MANY", 10)
    with an_explorer() as many:
        assert many.style == "points"
        many.set_style("gaussians")
        assert many.style == "gaussians"
        many.set_style("auto")
        assert many.style == "points"


def test_closing_twice_is_fine_and_errors_close(monkeypatch):
    explorer = an_explorer()
    explorer.close()
    explorer.close()
    closed = []
    monkeypatch.setattr(Explorer, "close", lambda self, close=Explorer.close: (closed.append(self), close(self)))
    lens = type(some_camera())(torch.eye(4), torch.eye(3), 4, 4, distortion=Distortion("brown_conrady", (0.1, 0, 0, 0)))
    with pytest.raises(ValueError, match=tells("camera:", "pinhole", "'brown_conrady'")):
        an_explorer(camera=lens)
    assert len(closed) == 1


def test_options_are_checked():
    with pytest.raises(ValueError, match=tells("rest:", "got 1.0")):
        ExploreOptions(rest=1.0)
    with pytest.raises(ValueError, match=tells("style:", "got 'ellipsoids'")):
        ExploreOptions(style="ellipsoids")
    with pytest.raises(ValueError, match=tells("height:", "got 0")):
        ExploreOptions(height=0)
    with pytest.raises(ValueError, match=tells("width:", "got 1")):
        ExploreOptions(width=1)


def test_unknown_styles_and_classes_are_refused(explorer):
    with pytest.raises(ValueError, match=tells("style:", "got 'cubes'")):
        explorer.set_style("cubes")
    with pytest.raises(ValueError, match=tells("class:", "got 'chiar'")):
        explorer.set_hidden(["chiar"])
    assert explorer.state.hidden == frozenset()


def test_a_closed_explorer_refuses_all_verbs_alike(tmp_path):
    explorer = an_explorer(out=tmp_path / "view")
    explorer.ask("chair")
    explorer.close()
    assert explorer.closed
    before = explorer.state.details()
    verbs = {
        "ask": ["sofa"],
        "set_gamma": [0.9],
        "set_distance": [0.1],
        "set_show": ["score"],
        "set_hidden": [["wall"]],
        "set_style": ["points"],
        "pick": [180, 110],
        "look_from": [some_camera()],
        "reset_view": [],
        "screenshot": [],
        "save_picture": [],
        "save_selection": [],
    }
    for name, arguments in verbs.items():
        message = ("explorer:", name, "explore(")
        with pytest.raises(RuntimeError, match=tells(*message)):
            getattr(explorer, name)(*arguments)
    assert explorer.state.details() == before
    assert not (tmp_path / "view").exists()
    assert explorer.lines()[0].startswith("'chair': score >")


def test_a_notebook_shows_a_line_where_the_explorer_is_closed():
    with an_explorer() as explorer:
        assert repr(explorer).startswith("<Explorer: semantic: ")
        assert explorer._repr_png_().startswith(b"\x89PNG")
    assert explorer._repr_png_() is None
    assert repr(explorer).startswith("<Explorer, closed: semantic: ")


def test_a_window_that_the_desktop_destroyed_counts_as_closed():
    with an_explorer() as explorer:
        explorer.plotter.close()
        assert explorer.closed
        with pytest.raises(RuntimeError, match=tells("explorer:", "open", "ask", "closed")):
            explorer.ask("chair")


def test_verbs_of_two_threads_leave_a_window_that_draws(monkeypatch):
    """Without a lock the second finds drawing suppressed by the first, and leaves it so."""
    inside, both, exchange = Event(), Event(), Explorer._update_panes

    def slowly(self):
        if not inside.is_set():
            inside.set()
            both.wait(0.3)  # for the second to begin, if it does not wait
        elif one.is_alive():
            both.set()
            one.join(20)  # and end after the first
        exchange(self)

    with an_explorer() as explorer:  # of which no frame was drawn yet
        monkeypatch.setattr(Explorer, "_update_panes", slowly)
        one = Thread(target=explorer.ask, args=["chair"])
        two = Thread(target=explorer.ask, args=["sofa"])
        one.start()
        assert inside.wait(10)
        two.start()
        for thread in (one, two):
            thread.join(20)
        assert not explorer.plotter.suppress_rendering
        assert explorer.state.asked.words == "sofa"
        assert agreement(explorer, "color", explorer.options.rest) > 45


def test_two_explorers_that_save_into_one_folder_lose_nothing(tmp_path, monkeypatch):
    """As two programs would: the second looks for a number before the first has written."""
    with an_explorer(out=tmp_path) as one, an_explorer(out=tmp_path) as two:
        for explorer in (one, two):
            explorer.ask("chair")
        draw, paths = Explorer.screenshot, []

        def late(self, path=None):
            if self is one and not paths:
                paths.append(two.save_picture())
            return draw(self, path)

        monkeypatch.setattr(Explorer, "screenshot", late)
        paths.append(one.save_picture())
        assert {path.name for path in paths} == {"picture_001.png", "picture_002.png"}
        assert all(np.asarray(Image.open(path)).shape == (240, 640, 3) for path in paths)
        monkeypatch.setattr(Path, "glob", lambda *_: iter(()))  # as both saw it: nothing there
        assert one.save_selection()[0].parent.name == "selection_001"
        assert two.save_selection()[0].parent.name == "selection_002"


def test_what_cannot_be_saved_leaves_nothing(tmp_path, monkeypatch):
    with an_explorer(out=tmp_path / "a" / "view") as explorer:
        with pytest.raises(ValueError, match=tells("selection:", "got none")):
            explorer.save_selection()
        assert not (tmp_path / "a" / "view").exists()
        explorer.save_picture()

        def fail(self, path=None):
            raise OSError("disk full")

        monkeypatch.setattr(Explorer, "screenshot", fail)
        with pytest.raises(OSError, match="disk full"):
            explorer.save_picture()
        assert [path.name for path in (tmp_path / "a" / "view").iterdir()] == ["picture_001.png"]
