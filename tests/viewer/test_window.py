"""Both clouds in pyvista, off-screen: what the rasteriser draws, and what the window's sliders do."""

import json
import math

import numpy as np
import pytest
import torch
from cases_explorer import cameras, classes, field
from cases_viz import some_camera, some_gaussians
from messages import refused

from kfgs.formats import read_splats
from kfgs.splat import rasterize
from kfgs.viewer import Exploration, Explorer, SplatMeaning, explore
from kfgs.viewer.window import REST
from kfgs.viz import palette
from kfgs.viz.plotter import trouble

NAMES = ("wall", "chair", "table", "sofa", "lamp")
TITLE, LEGEND = 30, 120  # pixels that a title and a legend cover
CAMERA = some_camera().resized(240, 320)


@pytest.fixture
def explorer(tmp_path):
    if trouble():
        pytest.skip(trouble())
    semantic = some_gaussians().replace(sh=None, scores=torch.linspace(0.2, 1, 60), names=NAMES)
    color = some_gaussians(90, seed=1).replace(features=None, labels=None)
    state = Exploration(SplatMeaning(semantic), color, cameras=[CAMERA])
    with Explorer(state, out=tmp_path, height=240, off_screen=True) as opened:
        opened.plotter.window_size = [640, 240]
        opened.look_from(CAMERA)
        yield opened


def agreement(explorer, side):
    """PSNR against what kfgs's own rasteriser makes of a side, on white."""
    state = explorer.state
    cloud, colors = state.cloud(side), state.colors(side)
    if state.asked is not None:
        rest = torch.from_numpy(~state.selected(side))
        cloud = cloud.replace(opacities=torch.where(rest, REST * cloud.opacities, cloud.opacities))
    cloud = cloud.replace(features=torch.from_numpy(colors / 255).float(), sh=None, labels=None, scores=None)
    truth = rasterize(cloud, CAMERA.to(torch.float32), background=torch.ones(3)).map.numpy()
    seen = explorer.screenshot()[:, 321 if side == "color" else 0 :][:, :319] / 255
    area = np.s_[TITLE:, LEGEND:300]
    return -10 * math.log10(((seen[area] - truth[:, 1 if side == "color" else 0 :][:, :319][area]) ** 2).mean())


@pytest.mark.parametrize("words", [None, "chair"])
@pytest.mark.parametrize("show", ["labels", "latents"])
def test_both_sides_agree_with_the_rasteriser(explorer, words, show):
    explorer.set_show(show)
    explorer.ask(words)
    for side in explorer.state.sides:
        assert agreement(explorer, side) > 38


def test_a_selection_is_written_with_its_numbers(explorer, tmp_path):
    refused(lambda: explorer.save_selection(), "selection:", "got none")
    explorer.ask("chair")
    for number in (1, 2):
        paths = explorer.save_selection()
        assert {path.parent for path in paths} == {tmp_path / f"selection_00{number}"}
    details = json.loads(paths[0].read_text())
    for side in ("semantic", "color"):
        selected = explorer.state.selected(side)
        written = read_splats(tmp_path / "selection_002" / f"selection_{side}.ply")
        assert (details[side]["selected"], len(written)) == (selected.sum(), selected.sum())
        assert sum(part["count"] for part in details["parts"][side]) <= selected.sum()


def test_the_windows_sliders_set_gamma_and_lambda(explorer, monkeypatch):
    explorer.ask("chair")
    monkeypatch.setattr("kfgs.viewer.window.has_display", lambda: True)
    explorer.plotter.off_screen = False  # it has no window all the same: it was made without
    monkeypatch.setattr(explorer.plotter, "show", lambda **_: None)
    explorer.show()
    for slider, value in zip(explorer.plotter.widgets.slider_widgets, (0.7, 0.25), strict=True):
        slider.GetRepresentation().SetValue(value)
        slider.InvokeEvent("EndInteractionEvent")
    assert (explorer.state.gamma, explorer.state.distance) == pytest.approx((0.7, 0.25))


def test_explore_draws_a_field_or_a_splat(tmp_path):
    if trouble():
        pytest.skip(trouble())
    with explore(field("fused"), classes=classes(), cameras=cameras(), where="picture", height=60) as view:
        assert view.ask("chair").words == "chair"
        assert view.screenshot(tmp_path / "chair.png").shape == (60, 60, 3)  # one cloud: half the width
    splat = some_gaussians().replace(names=NAMES)
    with explore(splat, splat, where="picture", height=60) as view:
        assert view.screenshot().shape == (60, 120, 3)
        shown = {tuple(color) for color in view.screenshot().reshape(-1, 3).tolist()}
        assert shown & {tuple(color) for color in palette(np.arange(5), NAMES).tolist()}  # the legend's


def test_what_cannot_be_explored_is_named(monkeypatch):
    refused(lambda: explore("field.kfgs", where="picture"), "source:", "SemanticField", "got str", error=TypeError)
    refused(lambda: explore(some_gaussians(), classes=classes(), where="picture"), "classes, embed:", "with a splat")
    refused(lambda: explore(some_gaussians(), where="tv"), "where:", "got 'tv'")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    if not trouble():
        refused(lambda: explore(some_gaussians(), where="window"), "where:", "display", "'browser'", error=RuntimeError)
