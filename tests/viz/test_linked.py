import numpy as np
import pytest
import torch
from cases_viz import data, some_camera, some_gaussians, some_plotter
from messages import refused, tells

from kfgs.labels import nearest_labels
from kfgs.viz import add_transfer, linked_clouds, make_plotter, palette
from kfgs.viz.linked import look_over
from kfgs.viz.pictures import draw_legend


@pytest.fixture(autouse=True)
def plotter():
    with some_plotter() as plotter:
        yield plotter


NAMES = [f"class {i}" for i in range(5)]


def test_both_clouds_are_seen_by_the_same_camera():
    gaussians, camera = some_gaussians(), some_camera(240, 320)
    plotter = linked_clouds(gaussians, gaussians, names=NAMES, camera=camera, height=240, off_screen=True)
    try:
        assert plotter.renderers[0].camera is plotter.renderers[1].camera
        picture = plotter.screenshot(return_img=True)
        assert picture.shape == (240, 640, 3)
        legend = draw_legend(gaussians.labels, NAMES, 14)
        height, width, _ = legend.shape
        np.testing.assert_array_equal(picture[230 - height : 230, 10 : 10 + width], legend)
        plotter.camera.azimuth += 90
        plotter.render()
        moved = plotter.screenshot(return_img=True)
        for half in (slice(160, 320), slice(320, 640)):
            assert (moved[:, half] != picture[:, half]).any(axis=2).mean() > 0.2
    finally:
        plotter.close()


def test_a_missing_label_closes_the_window_and_says_so():
    gaussians = some_gaussians()
    with pytest.raises(ValueError, match=tells("gaussians.labels:", "got None")):
        linked_clouds(gaussians.replace(labels=None), gaussians, off_screen=True)
    refused(lambda: linked_clouds(gaussians, gaussians, height=0), "height:", "got 0")


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.3, -0.9, 0.2), (1.0, 1.0, 1.0)])
def test_the_overview_stands_upright(up):
    gaussians = some_gaussians()
    plotter = make_plotter(60, 80, off_screen=True)
    try:
        look_over(plotter, gaussians, up)
        axis = np.array(up) / np.linalg.norm(up)
        camera = plotter.camera
        forward, view_up = np.array(camera.direction), np.array(camera.GetViewUp())
        assert forward @ axis == pytest.approx(-1 / np.sqrt(3))  # looks down as an isometric view does
        right = np.cross(forward, view_up)
        assert right @ axis == pytest.approx(0, abs=1e-9)
        assert view_up @ axis > 0
        middle = np.median(gaussians.means.numpy(), axis=0)
        assert (middle - camera.position) @ forward > 0
    finally:
        plotter.close()


def test_transfer_lines_join_destination_and_source(plotter):
    src, dst = some_gaussians(80, 1), some_gaussians(50, 2)
    transfer = nearest_labels(src.means, src.labels, dst.means, 0.3)
    assert 10 < transfer.labelled < 50
    lines = data(add_transfer(plotter, src, dst, transfer))
    assert lines.n_cells == transfer.labelled
    ends = lines.points.reshape(-1, 2, 3)
    np.testing.assert_allclose(ends[:, 0], dst.means[lines["destination"]])
    np.testing.assert_allclose(ends[:, 1], src.means[lines["source"]])
    np.testing.assert_allclose(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1), lines["distance"], atol=1e-6)
    np.testing.assert_array_equal(lines["label"], src.labels[lines["source"]])
    np.testing.assert_array_equal(lines["rgb"], palette(lines["label"]))
    names = [f"class {i}" for i in range(6)]
    named = data(add_transfer(plotter, src, dst, transfer, names=names))
    np.testing.assert_array_equal(named["rgb"], palette(lines["label"], names))
    moved = data(add_transfer(plotter, src, dst, transfer, shift=(0, 0, 2)))  # to where the destinations are drawn
    np.testing.assert_allclose(moved.points[::2], ends[:, 0] + np.array([0, 0, 2]), rtol=1e-6)
    np.testing.assert_allclose(moved.points[1::2], ends[:, 1])
    few = data(add_transfer(plotter, src, dst, transfer, sample=7))
    assert few.n_cells == 7
    assert len(set(few["destination"])) == 7


def test_wrong_transfers_are_named(plotter):
    src, dst = some_gaussians(80, 1), some_gaussians(50, 2)
    transfer = nearest_labels(src.means, src.labels, dst.means, 0.3)
    refused(lambda: add_transfer(plotter, src, src, transfer), "transfer.labels:", "[N]", "N = 80", "got (50,)")
    refused(lambda: add_transfer(plotter, src.select(torch.arange(2)), dst, transfer), "transfer:", "got 75")
    with pytest.raises(ValueError, match=tells("transfer:", "got none", "1e-09", "distance")):
        add_transfer(plotter, src, dst, nearest_labels(src.means, src.labels, dst.means, 1e-9))
