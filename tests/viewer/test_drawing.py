import numpy as np
import pytest
import torch
from cases_viz import some_camera
from cases_window import LEGEND, NAMES, TITLE, agreement, panes

from kfgs.viewer import drawing
from kfgs.viz import gaussian_actor, palette
from kfgs.viz.legends import bar_picture
from kfgs.viz.pictures import legend_column

pytestmark = pytest.mark.usefixtures("driver")


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
        assert (pixels == palette(np.array(1), explorer.state.meaning.names)).all(axis=1).sum() > 20
        assert not (pixels == palette(np.array(4), explorer.state.meaning.names)).all(axis=1).any()
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


def test_no_ring_is_drawn_for_what_is_behind_the_camera(explorer):
    explorer.pick(180, 110)
    backwards = some_camera().resized(240, 320)
    turn = torch.diag(torch.tensor([-1.0, 1, -1, 1], dtype=torch.float64))
    explorer.look_from(type(backwards)(turn @ backwards.viewmat, backwards.K, 320, 240))
    assert (explorer.screenshot()[TITLE:, 325:] == 255).all()
    explorer.reset_view()
    assert explorer.state.picked is not None


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
