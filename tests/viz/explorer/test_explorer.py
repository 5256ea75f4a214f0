import math

import numpy as np
import pytest
import torch
from cases_viz import some_camera, some_gaussians
from PIL import Image

from kfgs.cameras import Distortion
from kfgs.formats import SplatFile
from kfgs.splat.rasterize import rasterize
from kfgs.viz import available, gaussian_actor, headless, legend_column, palette
from kfgs.viz.explorer import ExploreOptions, Explorer, drawing, gaussian_at
from kfgs.viz.explorer.exploration import Exploration
from kfgs.viz.explorer.meaning import SplatMeaning
from kfgs.viz.legends import bar_picture

NAMES = ("wall", "chair", "table", "sofa", "lamp")
TITLE, LEGEND = 30, 120  # pixels that a title and a legend cover
SMALL = {"height": 240, "width": 640}


@pytest.fixture(autouse=True)
def driver():
    if not available():
        pytest.skip(headless.probe().reason)


def a_state(sides=2, **options):
    semantic, color = some_gaussians(), some_gaussians(90, seed=1)
    semantic = semantic.replace(sh=None)
    color = color.replace(features=None, labels=None)
    scores = torch.linspace(0.2, 1, len(semantic)).numpy()
    meaning = SplatMeaning(SplatFile(semantic, {"score": scores}, NAMES))
    return Exploration(meaning, color if sides == 2 else None, **options)


def an_explorer(state=None, **options):
    camera = options.pop("camera", some_camera().resized(240, 320))
    return Explorer(state or a_state(), ExploreOptions(**(SMALL | options)), camera=camera, off_screen=True)


@pytest.fixture(scope="module")
def shared():
    """One window for the tests that leave nothing behind: `an_explorer` takes half a second."""
    if not available():
        pytest.skip(headless.probe().reason)
    with an_explorer() as explorer:
        yield explorer


@pytest.fixture
def explorer(shared):
    shared.ask(None)
    shared.set_show("labels")
    shared.set_hidden([])
    shared.set_style("gaussians")
    shared.state.drop_pick()
    return shared


def expected(state, side, rest=1.0):
    """What kfgs's own rasteriser makes of a side, on white."""
    cloud = state.cloud(side)
    opacities = cloud.opacities.clone()
    if state.asked is not None:
        opacities[torch.from_numpy(~state.selected(side))] *= rest
    opacities[torch.from_numpy(~state.drawn(side))] = 0
    colors = torch.from_numpy(state.colors(side) / 255).float()
    cloud = cloud.replace(features=colors, sh=None, labels=None, opacities=opacities)
    cloud = cloud.select(opacities > 0)
    seen = rasterize(cloud, some_camera().resized(240, 320).to(torch.float32))
    return (seen.map + (1 - seen.alpha)[..., None]).numpy()


def psnr(seen, other):
    return -10 * math.log10(((seen - other) ** 2).mean())


def panes(picture):
    return {"semantic": picture[:, :319], "color": picture[:, 321:]}  # a line lies between them


def agreement(explorer, side, rest=1.0):
    seen = panes(explorer.screenshot() / 255)[side]
    other = expected(explorer.state, side, rest)
    other = other[:, :319] if side == "semantic" else other[:, 1:]
    return psnr(seen[TITLE:, LEGEND:300], other[TITLE:, LEGEND:300])


@pytest.mark.parametrize("side", ["semantic", "color"])
def test_the_picture_is_that_of_the_rasteriser(explorer, side):
    assert agreement(explorer, side) > 45  # measured: 49 and more
    explorer.set_hidden(["wall", 2])
    assert agreement(explorer, side) > 45


@pytest.mark.parametrize("side", ["semantic", "color"])
def test_what_is_not_selected_is_drawn_with_a_fraction_of_its_opacity(explorer, side):
    explorer.ask("chair")
    assert agreement(explorer, side, explorer.options.rest) > 45
    assert 0 < explorer.state.selected(side).sum() < len(explorer.state.cloud(side))


def test_a_slider_changes_the_picture(explorer):
    explorer.ask("sofa")
    before = explorer.screenshot()
    explorer.set_gamma(0.8)
    after = explorer.screenshot()
    assert (before != after).any()
    assert agreement(explorer, "color", explorer.options.rest) > 45
    explorer.set_distance(0.2)
    assert (panes(explorer.screenshot())["color"] != panes(after)["color"]).any()
    assert agreement(explorer, "color", explorer.options.rest) > 45
    explorer.set_distance(1.0)


def test_a_selection_in_its_own_colours_is_tinted(explorer):
    explorer.set_show("rgb")
    plain = np.array(explorer.panes[1]._gaussians.mapper.dataset["rgb"])
    explorer.ask("chair")
    drawn = explorer.panes[1]._gaussians.mapper.dataset
    selected = explorer.state.selected("color")[np.asarray(drawn["index"])]
    tinted = np.array(drawn["rgb"]).astype(int)
    half = (plain[selected].astype(int) + np.array((255, 120, 0))) // 2
    np.testing.assert_array_equal(tinted[selected], half)
    np.testing.assert_array_equal(tinted[~selected], plain[~selected])


def test_points_show_the_same_selection(explorer):
    explorer.set_style("points")
    explorer.set_hidden(["lamp"])
    explorer.ask("chair")
    for pane, side in zip(explorer.panes, explorer.state.sides, strict=True):
        clear, rest = (actor.mapper.dataset for actor in pane._points[:2])
        opaque = explorer.state.cloud(side).opacities.numpy() > 0.1
        selected, drawn = explorer.state.selected(side), explorer.state.drawn(side)
        np.testing.assert_array_equal(clear["index"], np.flatnonzero(selected & opaque))
        np.testing.assert_array_equal(rest["index"], np.flatnonzero(drawn & ~selected & opaque))
        np.testing.assert_array_equal(clear["rgb"], explorer.state.colors(side)[clear["index"]])
        np.testing.assert_array_equal(clear.points, explorer.state.cloud(side).means.numpy()[clear["index"]])
    picture = explorer.screenshot()
    for half in panes(picture).values():
        pixels = half[TITLE:, LEGEND:].reshape(-1, 3)
        assert (pixels == palette(np.array(1))).all(axis=1).sum() > 20
        assert not (pixels == palette(np.array(4))).all(axis=1).any()
    explorer.set_style("gaussians")
    assert agreement(explorer, "color", explorer.options.rest) > 45


def test_few_points_stand_for_many_while_the_view_turns(explorer, monkeypatch):
    monkeypatch.setattr(drawing, "MOVING_POINTS", 20)
    explorer.set_style("points")
    still = explorer.screenshot()
    window = explorer.plotter.render_window
    window.SetDesiredUpdateRate(15.0)
    fast = explorer.screenshot()
    drawn = [(half[TITLE:, LEGEND:] != 255).any(axis=2).sum() for half in panes(fast).values()]
    assert all(0 < pixels < 20 * 36 for pixels in drawn)
    assert (still[TITLE:, LEGEND:] != 255).any(axis=2).sum() > 2 * sum(drawn)
    explorer.set_style("gaussians")
    window.SetDesiredUpdateRate(0.0001)
    assert agreement(explorer, "color") > 45
    explorer.set_style("points")
    np.testing.assert_array_equal(explorer.screenshot(), still)


def test_points_of_nothing_are_none(explorer):
    explorer.set_style("points")
    explorer.set_hidden([-1, *range(5)])
    assert (explorer.screenshot()[TITLE:, 321:] == 255).all()
    assert explorer.pick(480, 120) is None
    explorer.set_hidden([])
    assert (explorer.screenshot()[TITLE:, 321:] != 255).any()


def test_the_legend_lists_what_is_drawn(explorer):
    explorer.set_hidden(["lamp", -1])
    picture = explorer.screenshot()
    legend = legend_column(np.arange(4), NAMES)
    height, width, _ = legend.shape
    np.testing.assert_array_equal(picture[230 - height : 230, 10 : 10 + width], legend)
    explorer.set_show("score")
    moved = explorer.screenshot()
    assert (moved[230 - height : 230, 10 : 10 + width] != legend).any()
    bar = bar_picture(explorer.state.clim, "score", 240, 320)
    height, width, _ = bar.shape
    np.testing.assert_array_equal(moved[230 - height : 230, 630 - width : 630], bar)
    explorer.set_show("labels")
    np.testing.assert_array_equal(explorer.screenshot(), picture)


def test_verbs_leave_no_actors_behind(explorer):
    explorer.ask("chair")
    counts = [renderer.GetViewProps().GetNumberOfItems() for renderer in explorer.plotter.renderers]
    for words in ("sofa", None, "chair"):
        explorer.ask(words)
    assert [renderer.GetViewProps().GetNumberOfItems() for renderer in explorer.plotter.renderers] == counts


@pytest.mark.parametrize("side", ["semantic", "color"])
def test_a_click_picks_what_is_seen_there(explorer, side):
    """The rendering with one channel for each Gaussian says what weighs most at the pixel."""
    cloud = explorer.state.cloud(side)
    camera = some_camera().resized(240, 320).to(torch.float32)
    named = cloud.replace(features=torch.eye(len(cloud)), sh=None, labels=None)
    weights = rasterize(named, camera).map
    for row, column in ((120, 160), (100, 180), (140, 200), (90, 120)):
        x = column + 0.5 + (320 if side == "color" else 0)
        picked = explorer.pick(x, row + 0.5)
        if weights[row, column].sum() < 0.05:
            assert picked is None
        else:
            assert (picked.side, picked.index) == (side, int(weights[row, column].argmax()))


def test_what_is_clearly_seen_is_picked_first_and_hidden_gaussians_never(explorer):
    explorer.ask("chair")
    cloud, labels = explorer.state.cloud("semantic"), explorer.state.labels("semantic")
    camera = some_camera().resized(240, 320).to(torch.float32)
    chairs = torch.from_numpy(explorer.state.selected("semantic"))
    faint = 0
    for x, y in [(x, y) for x in range(80, 300, 55) for y in range(60, 200, 45)]:
        clear, any_ = gaussian_at(cloud, camera, x, y, chairs), gaussian_at(cloud, camera, x, y)
        picked = explorer.pick(x, y)
        assert (None if picked is None else picked.index) == (any_ if clear is None else clear)
        faint += clear is None and any_ is not None
        explorer.set_hidden(["chair"])
        picked = explorer.pick(x, y)
        assert picked is None or labels[picked.index] != 1
        explorer.set_hidden([])
    assert faint > 0


def test_what_is_picked_has_a_ring_in_both_panes(explorer):
    before = explorer.screenshot()
    picked = explorer.pick(180, 110)
    after = explorer.screenshot()
    camera = some_camera().resized(240, 320)
    x, y, z = camera.K @ (camera.viewmat @ torch.tensor([*picked.position, 1.0], dtype=torch.float64))[:3]
    for left in (0, 320):
        rows, columns = np.nonzero((before != after)[:, left : left + 320].any(axis=2))
        assert rows.mean() == pytest.approx(float(y / z), abs=1.5)
        assert columns.mean() == pytest.approx(float(x / z), abs=1.5)
        assert 20 <= np.ptp(rows) <= 26
    assert explorer.lines()[-2:] == picked.lines()[-2:]
    explorer.pick(320 * 2 - 1, 239)  # the background drops it
    assert explorer.state.picked is None
    np.testing.assert_array_equal(explorer.screenshot(), before)


def test_no_ring_is_drawn_for_what_is_behind_the_camera(explorer):
    explorer.pick(180, 110)
    backwards = some_camera().resized(240, 320)
    turn = torch.diag(torch.tensor([-1.0, 1, -1, 1], dtype=torch.float64))
    explorer.look_from(type(backwards)(turn @ backwards.viewmat, backwards.K, 320, 240))
    assert (explorer.screenshot()[TITLE:, 325:] == 255).all()
    explorer.reset_view()
    assert explorer.state.picked is not None


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


def test_while_the_view_turns_points_keep_the_selection_before_the_rest(explorer, monkeypatch):
    monkeypatch.setattr(gaussian_actor, "SLOW", 0.0)
    explorer.ask("chair")
    still = explorer.screenshot()
    window = explorer.plotter.render_window
    window.SetDesiredUpdateRate(15.0)
    explorer.screenshot()
    for pane, side in zip(explorer.panes, explorer.state.sides, strict=True):
        points = [actor for actor in pane.renderer.GetViewProps() if actor.IsA("vtkActor") and actor.GetVisibility()]
        counts = {actor.prop.opacity: actor.mapper.dataset.n_points for actor in points}
        opacities, selected = explorer.state.cloud(side).opacities.numpy(), explorer.state.selected(side)
        faint = opacities * np.where(selected, 1, explorer.options.rest)
        assert counts[1.0] == (faint > 0.1).sum()
        assert counts[gaussian_actor.FAINT_ALPHA] == ((faint <= 0.1) & (faint >= 1 / 255)).sum()
    explorer.set_style("points")  # in the midst of it
    window.SetDesiredUpdateRate(0.0001)
    explorer.screenshot()
    explorer.set_style("gaussians")
    np.testing.assert_array_equal(explorer.screenshot(), still)


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
