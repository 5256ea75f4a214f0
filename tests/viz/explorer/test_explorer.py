import numpy as np
import pytest
import torch
from cases_viz import some_camera
from cases_window import LEGEND, SMALL, TITLE, a_state, agreement, an_explorer, panes, psnr
from PIL import Image

from kfgs.cameras import Distortion
from kfgs.splat.rasterize import rasterize
from kfgs.viz.explorer import ExploreOptions, Explorer

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
    with pytest.raises(ValueError, match="chiar"):
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
        with pytest.raises(ValueError, match="selection: expected at least one Gaussian"):
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


def test_auto_draws_points_where_a_frame_is_slow(monkeypatch):
    from kfgs.viz.explorer import first_frame as module

    monkeypatch.setattr(module, "SURE", 10)
    with an_explorer() as quick:
        assert quick.style == "gaussians"
    monkeypatch.setattr(module, "SLOW", 0.0)
    with an_explorer() as slow:
        assert slow.style == "points"
        slow.set_style("gaussians")
        slow.screenshot()
        assert slow.style == "gaussians"
        slow.set_style("auto")
        assert slow.style == "points"
    monkeypatch.setattr(module, "SURE", 1000)
    with an_explorer() as small:
        assert small.style == "gaussians"


def test_closing_twice_is_fine_and_errors_close(monkeypatch):
    explorer = an_explorer()
    explorer.close()
    explorer.close()
    closed = []
    monkeypatch.setattr(Explorer, "close", lambda self, close=Explorer.close: (closed.append(self), close(self)))
    lens = type(some_camera())(torch.eye(4), torch.eye(3), 4, 4, distortion=Distortion("brown_conrady", (0.1, 0, 0, 0)))
    with pytest.raises(ValueError, match="camera: expected a pinhole camera"):
        an_explorer(camera=lens)
    assert len(closed) == 1


def test_options_are_checked():
    with pytest.raises(ValueError, match="rest: expected a number in"):
        ExploreOptions(rest=1.0)
    with pytest.raises(ValueError, match="style: expected one of"):
        ExploreOptions(style="ellipsoids")
    with pytest.raises(ValueError, match="height: expected"):
        ExploreOptions(height=0)
    with pytest.raises(ValueError, match="width: expected"):
        ExploreOptions(width=1)


def test_unknown_styles_and_classes_are_refused(explorer):
    with pytest.raises(ValueError, match="style: expected one of"):
        explorer.set_style("cubes")
    with pytest.raises(ValueError, match="chair"):
        explorer.set_hidden(["chiar"])
    assert explorer.state.hidden == frozenset()
