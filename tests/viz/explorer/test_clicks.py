import numpy as np
import pytest
import torch
from cases_viz import some_camera

from kfgs.splat.rasterize import rasterize
from kfgs.viz.explorer import gaussian_at

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
