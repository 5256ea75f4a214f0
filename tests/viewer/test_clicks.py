import numpy as np
import pytest
import torch
from cases_viz import some_camera, some_gaussians
from cases_window import LEGEND, NAMES, TITLE, an_explorer, panes
from messages import tells

from kfgs.splat.rasterize import rasterize
from kfgs.viewer import drawing, gaussian_at
from kfgs.viewer.meaning import SplatMeaning
from kfgs.viewer.state import Exploration
from kfgs.viz import palette

pytestmark = pytest.mark.usefixtures("driver")


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


def places(width=320, height=240):
    return [(x + 0.5, y + 0.5) for x in range(60, width - 20, 20) for y in range(40, height - 20, 20)]


def picked_at(explorer):
    return {place: None if found is None else found.index for place in places() for found in [explorer.pick(*place)]}


def test_points_that_are_not_drawn_are_not_picked():
    """Style "points" leaves Gaussians of opacity 0.1 and less out, asked for or not."""
    semantic = some_gaussians().replace(sh=None)
    semantic.opacities[::2] = 0.09
    with an_explorer(Exploration(SplatMeaning(semantic.replace(names=NAMES)))) as explorer:
        assert any(index is not None and index % 2 == 0 for index in picked_at(explorer).values())
        explorer.set_style("points")
        for words in (None, "chair"):
            explorer.ask(words)
            drawn = np.concatenate([actor.mapper.dataset["index"] for actor in explorer.panes[0]._points[:2]])
            found = {index for index in picked_at(explorer).values() if index is not None}
            assert found <= set(drawn.tolist())
            assert found


def test_of_the_rest_only_those_that_are_drawn_as_points_are_picked(explorer, monkeypatch):
    monkeypatch.setattr(drawing, "REST_POINTS", 5)
    explorer.set_style("points")
    explorer.ask("chair")
    pane, selected = explorer.panes[0], explorer.state.selected("semantic")
    few = set(np.asarray(pane._points[1].mapper.dataset["index"]).tolist())
    assert len(few) == 5
    found = {index for index in picked_at(explorer).values() if index is not None and not selected[index]}
    assert found
    assert found <= few


@pytest.mark.parametrize("style", ["gaussians", "points"])
def test_a_rest_that_is_not_drawn_is_not_picked(style):
    with an_explorer(rest=0.0, style=style) as explorer:
        everything = picked_at(explorer)
        explorer.ask("chair")
        selected = explorer.state.selected("semantic")
        found = picked_at(explorer)
        assert all(index is None or selected[index] for index in found.values())
        assert any(index is None and everything[place] is not None for place, index in found.items())
        half = panes(explorer.screenshot())["semantic"]
        assert not (half == palette(np.array(2))).all(axis=2)[TITLE:, LEGEND:].any()


@pytest.mark.parametrize(("place", "told"), [(("a", 1), "x:"), ((1, None), "y:"), ((True, 1), "x:")])
def test_a_place_is_two_numbers(explorer, place, told):
    with pytest.raises(TypeError, match=tells(told, "number", "float")):
        explorer.pick(*place)


def test_a_place_is_finite(explorer):
    with pytest.raises(ValueError, match=tells("x:", "(-inf, inf)", "got nan")):
        explorer.pick(float("nan"), 1)
