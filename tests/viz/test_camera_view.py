import numpy as np
import pytest
import torch
from cases_viz import some_camera, some_gaussians, some_plotter
from kfgs.viz.camera_view import camera_of
from messages import tells

from kfgs.viz import add_cloud, draw_view, look_through, make_plotter


def test_camera_of_is_look_through_backwards():
    camera = some_camera()  # off-centre, two focal lengths, turned
    with some_plotter() as plotter:
        look_through(plotter, camera)
        found = camera_of(plotter, near=0.05)
    assert found.size == camera.size
    assert found.near == 0.05
    torch.testing.assert_close(found.viewmat, camera.viewmat, rtol=0, atol=1e-12)
    torch.testing.assert_close(found.K, camera.K, rtol=1e-12, atol=1e-9)


def test_camera_of_projects_as_vtk_does_whatever_turned_the_view():
    from vtkmodules.vtkRenderingCore import vtkCoordinate

    with some_plotter():
        plotter = make_plotter(90, 260, shape=(1, 2), off_screen=True)
    try:
        plotter.subplot(0, 1)
        plotter.camera_position = [(3, -4, 2), (0.2, 0.1, -0.3), (0.1, 0.2, 1)]
        plotter.camera.azimuth, plotter.camera.elevation, plotter.camera.roll = 33, -21, 77
        plotter.camera.SetWindowCenter(0.2, -0.3)
        plotter.camera.view_angle = 41
        camera = camera_of(plotter, (0, 1))
        assert camera.size == (90, 130)
        points = np.random.default_rng(0).uniform(-0.8, 0.8, (20, 3))
        seen = camera.K.numpy() @ (camera.viewmat[:3, :3].numpy() @ points.T + camera.viewmat[:3, 3:].numpy())
        place = vtkCoordinate()
        place.SetCoordinateSystemToWorld()
        for point, (x, y) in zip(points, (seen[:2] / seen[2]).T, strict=True):
            place.SetValue(*point)
            expected = place.GetComputedDoubleDisplayValue(plotter.renderers[1])
            assert (x + 130, 90 - y) == pytest.approx(expected, abs=1.01)  # VTK numbers pixels, and rounds down
    finally:
        plotter.close()


def test_parallel_rays_are_of_no_pinhole_camera():
    with some_plotter() as plotter:
        plotter.enable_parallel_projection()
        with pytest.raises(ValueError, match=tells("plotter:", "perspective")):
            camera_of(plotter)


def test_draw_view_is_a_plotter_that_looks_through_the_camera_and_is_closed():
    camera, cloud, used = some_camera(), some_gaussians(), []
    with some_plotter() as plotter:
        add_cloud(plotter, cloud)
        look_through(plotter, camera)
        expected = plotter.screenshot(return_img=True)

    def draw(plotter):
        used.append(plotter)
        add_cloud(plotter, cloud)

    picture = draw_view(camera, draw, background="black")
    assert picture.shape == (*camera.size, 3)
    assert np.array_equal(picture, expected)
    assert picture.any()
    assert (draw_view(camera, lambda plotter: None) == 255).all()

    def fail(plotter):
        used.append(plotter)
        raise KeyError("draw")

    with pytest.raises(KeyError):
        draw_view(camera, fail)
    assert [plotter.render_window for plotter in used] == [None, None]
