"""Two clouds in one plotter: next to each other, and one over the other with the labels that pass between them."""

import numpy as np
import pytest
import pyvista as pv
import torch
from cases_viz import data, some_camera, some_gaussians, some_plotter
from messages import refused

from kfgs.cameras import Orbit, orbit_cameras
from kfgs.gaussians import Gaussians
from kfgs.viz import add_cloud, linked_clouds, palette, show_transfer
from kfgs.viz.linked import look_over
from kfgs.viz.pictures import draw_legend


@pytest.fixture(autouse=True)
def plotter():
    with some_plotter() as plotter:
        yield plotter
    pv.close_all()


NAMES = tuple(f"class {i}" for i in range(5))
SRC, DST = some_gaussians(80, 1).replace(names=NAMES), some_gaussians(50, 2)


def test_both_clouds_are_seen_by_the_same_camera():
    gaussians, camera = some_gaussians().replace(names=NAMES), some_camera(240, 320)
    plotter = linked_clouds(gaussians, gaussians, camera=camera, height=240, off_screen=True)
    assert plotter.renderers[0].camera is plotter.renderers[1].camera
    picture = plotter.screenshot(return_img=True)
    assert picture.shape == (240, 640, 3)
    legend = draw_legend(gaussians.labels, NAMES, size=14)
    height, width, _ = legend.shape
    np.testing.assert_array_equal(picture[230 - height : 230, 10 : 10 + width], legend)
    plotter.camera.azimuth += 90
    plotter.render()
    moved = plotter.screenshot(return_img=True)
    for half in (slice(160, 320), slice(320, 640)):
        assert (moved[:, half] != picture[:, half]).any(axis=2).mean() > 0.2


def test_a_missing_label_closes_the_window_and_says_so():
    gaussians = some_gaussians()
    unlabelled = gaussians.replace(labels=None)
    refused(lambda: linked_clouds(unlabelled, gaussians, off_screen=True), "semantic:", "expected labels")
    refused(lambda: linked_clouds(gaussians, gaussians, height=0), "height:", "got 0")


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.3, -0.9, 0.2), (1.0, 1.0, 1.0)])
def test_the_overview_stands_upright(plotter, up):
    add_cloud(plotter, DST)
    look_over(plotter, up)
    axis, camera = np.array(up) / np.linalg.norm(up), plotter.camera
    forward, view_up = np.array(camera.direction), np.array(camera.GetViewUp())
    assert forward @ axis == pytest.approx(-1 / np.sqrt(3))  # looks down as an isometric view does
    assert np.cross(forward, view_up) @ axis == pytest.approx(0, abs=1e-9)
    assert view_up @ axis > 0
    assert (np.median(DST.means.numpy(), axis=0) - camera.position) @ forward > 0


def opened(*args, **options):
    return show_transfer(*args, height=200, off_screen=True, **options)


def lines_of(plotter):
    return data(plotter.actors["transfer"])


def text_of(plotter):
    return plotter.actors["transfer text"].GetText(2)


def test_lines_join_lifted_destinations_to_their_sources_for_the_sliders_lambda():
    plotter = opened(SRC, DST, 0.3)
    lines = lines_of(plotter)
    destination, source = lines["destination"], lines["source"]
    ends = lines.points.reshape(-1, 2, 3)
    np.testing.assert_allclose(ends[:, 1], SRC.means[source])
    lift = ends[:, 0] - DST.means.numpy()[destination]
    np.testing.assert_allclose(lift, np.array([[0, 0, lift[0, 2]]]).repeat(len(lift), 0), atol=1e-6)
    assert lift[0, 2] > 1.5
    np.testing.assert_allclose(np.linalg.norm((DST.means[destination] - SRC.means[source]), axis=1), lines["distance"])
    np.testing.assert_array_equal(lines["label"], SRC.labels[source])
    np.testing.assert_array_equal(lines["rgb"], palette(lines["label"], NAMES))
    assert f"{50 - lines.n_cells} without a label" in text_of(plotter)
    before = plotter.screenshot(return_img=True)
    (slider,) = plotter.widgets.slider_widgets
    slider.GetRepresentation().SetValue(0.1)
    slider.InvokeEvent("EndInteractionEvent")
    assert 0 < lines_of(plotter).n_cells < lines.n_cells
    assert (lines_of(plotter)["distance"] < 0.1).all()
    assert (plotter.screenshot(return_img=True) != before)[:10, :100].any()  # the text
    slider.GetRepresentation().SetValue(1e-9)
    slider.InvokeEvent("EndInteractionEvent")
    assert "transfer" not in plotter.actors
    assert "50 without a label" in text_of(plotter)


def test_a_pick_names_the_gaussian_and_who_gave_its_label():
    plotter, told = opened(SRC, DST), set()
    plotter.screenshot()
    for x, y in np.ndindex(14, 14):
        plotter.iren.picker.Pick(14 * x, 14 * y, 0, plotter.renderer)
        told.add(text_of(plotter).split("\n")[-1])
    lines = lines_of(plotter)
    links = zip(*(lines[name] for name in ("destination", "label", "source", "distance")), strict=True)
    given = {f"colour Gaussian {i}: {NAMES[c]} from semantic Gaussian {k}, {far:.3g} away" for i, c, k, far in links}
    below = {f"semantic Gaussian {i}: {NAMES[label]}" for i, label in enumerate(SRC.labels) if label >= 0}
    assert min(len(told & given), len(told & below)) > 5


def test_far_coordinates_change_nothing():
    far = torch.tensor([1.0, 0, 0])
    there = opened(SRC.replace(origin=(5e5, 4e6, 0)), DST.replace(means=DST.means - far, origin=(5e5 + 1, 4e6, 0)), 0.3)
    np.testing.assert_allclose(lines_of(there).points, lines_of(opened(SRC, DST, 0.3)).points, atol=1e-5)


def test_what_encloses_the_cameras_is_left_out_and_nothing_of_a_thing_that_they_surround():
    """A round wall and a lid, with a table in the middle."""
    angle, far, z = torch.rand(3, 4000, generator=torch.Generator().manual_seed(0))
    far, z = torch.cat([far[:1000].sqrt(), torch.ones(3000)]), torch.cat([torch.ones(1000), z[1000:]])
    means = torch.stack([3 * far * torch.cos(6.3 * angle), 3 * far * torch.sin(6.3 * angle), 3 * z - 1.5], dim=1)
    shell, table = some_gaussians(4000).replace(means=means), SRC.replace(means=0.3 * SRC.means, names=())
    room = Gaussians.cat([shell, table])
    views = orbit_cameras(table.means, Orbit(frames=12, size=(60, 80), elevation_degrees=0))
    for options, enclosed in (({}, True), ({"cameras": views, "whole": True}, True), ({"cameras": views}, False)):
        ends = room.means[lines_of(opened(room, room, **options))["destination"]]
        assert bool(((ends[:, 2] > 0.3) & (ends.norm(dim=1) > 1)).any()) == enclosed
    for around in (views, views[:6]):
        assert lines_of(opened(table, table, cameras=around)).n_cells == lines_of(opened(table, table)).n_cells


def test_what_cannot_be_shown_is_named():
    refused(lambda: show_transfer(SRC.replace(labels=None), DST), "field:", "expected labels", "SemanticField.label")
    refused(lambda: show_transfer(SRC.replace(labels=torch.full((80,), -1)), DST), "field:", "with a class")
    refused(lambda: show_transfer(SRC, DST.replace(sh=None)), "splat:", "with colours")
    refused(lambda: show_transfer(SRC, DST[:0]), "splat:", "got Gaussians(0")
    refused(lambda: show_transfer(SRC, DST, -1.0, off_screen=True), "distance:", "got -1")
    refused(lambda: show_transfer("field.kfgs", DST), "field:", "got str", error=TypeError)
