import numpy as np
import pytest
import torch
from cases_viz import some_gaussians, some_plotter
from kfgs.viz.framing import middle_box

from kfgs.viz import add_cloud

STYLES = ("points", "gaussians", "ellipsoids")


def with_floaters(count=3):
    """400 Gaussians in [-1, 1]^3, some of them 1000 away, and opaque."""
    gaussians = some_gaussians(400)
    means, opacities = gaussians.means.clone(), gaussians.opacities.clone()
    means[:count], opacities[:count] = torch.tensor([-1000.0, -400, -700]), 0.9
    return gaussians.replace(means=means, opacities=opacities)


def test_the_box_leaves_one_in_a_hundred_out_on_each_side():
    points = np.random.default_rng(0).permutation(np.arange(1000.0))[:, None] * [1.0, -2.0, 0.0]
    low, high = 10 - 0.05 * 979, 989 + 0.05 * 979
    np.testing.assert_allclose(middle_box(points), [max(low, 0), min(high, 999), -1998, 0, 0, 0])
    points[:5], points[5:10] = 1e6, -1e6
    assert np.abs(middle_box(points)).max() < 2100
    few = np.array([[0.0, 0, 0], [1, 2, 3]])
    assert middle_box(few).tolist() == [0, 1, 0, 2, 0, 3]


@pytest.mark.parametrize("style", STYLES)
def test_a_floater_does_not_set_the_camera(style):
    with some_plotter() as plotter:
        add_cloud(plotter, with_floaters(1), style=style)
        for reset in (lambda: None, plotter.reset_camera, plotter.view_xy):
            reset()
            picture = plotter.screenshot(return_img=True)
            assert np.linalg.norm(plotter.camera.focal_point) < 0.5
            assert plotter.camera.distance < 10
            assert picture.any(axis=2).mean() > 0.05
            assert plotter.camera.clipping_range[1] > 700  # the floater is small, but not cut off


def test_other_actors_are_framed_with_the_middle_of_clouds():
    import pyvista as pv

    with some_plotter() as plotter:
        add_cloud(plotter, with_floaters())
        add_cloud(plotter, with_floaters().replace(means=with_floaters().means + 5))
        plotter.add_mesh(pv.Cube(center=(-19.5, 0, 0)))
        plotter.screenshot(return_img=True)
        # x from -20 to 6, y and z from -1 to 6
        assert plotter.camera.focal_point == pytest.approx((-7, 2.5, 2.5), abs=0.1)
        assert plotter.camera.parallel_scale == pytest.approx(np.linalg.norm([26, 7, 7]) / 2, rel=0.02)


def test_a_box_of_the_caller_stays():
    with some_plotter() as plotter:
        add_cloud(plotter, with_floaters())
        plotter.screenshot(return_img=True)
        plotter.reset_camera(bounds=(0, 10, 0, 10, 0, 10))
        assert plotter.camera.focal_point == (5, 5, 5)
        assert plotter.camera.parallel_scale == pytest.approx(np.sqrt(300) / 2)


def test_a_cloud_without_floaters_is_framed_as_pyvista_does():
    with some_plotter() as plotter:
        actor = add_cloud(plotter, some_gaussians(60))
        plotter.screenshot(return_img=True)
        low, high = np.array(actor.bounds).reshape(3, 2).T
        assert plotter.camera.focal_point == pytest.approx((low + high) / 2)
        assert plotter.camera.parallel_scale == pytest.approx(np.linalg.norm(high - low) / 2)
