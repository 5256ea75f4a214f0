import os
import subprocess
import sys

import numpy as np
import pytest
import pyvista as pv
from cases_viz import some_camera, some_gaussians, some_plotter
from messages import refused

from kfgs.viz import add_cloud, draw_view, look_through, make_plotter, plotter
from kfgs.viz.plotter import trouble


@pytest.fixture
def bare(monkeypatch):
    """A Linux without a display, and nothing probed yet; the environment comes back afterwards."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY", *plotter.WITHOUT_DISPLAY):
        monkeypatch.setenv(name, "to be restored")
        monkeypatch.delenv(name)
    monkeypatch.setattr(sys, "platform", "linux")
    plotter.trouble.cache_clear()
    yield monkeypatch
    plotter.trouble.cache_clear()


def test_egl_is_chosen_only_without_any_display(bare):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        bare.setenv(name, ":0")
        plotter.prepare()
        assert plotter.has_display()
        assert not plotter.WITHOUT_DISPLAY.keys() & os.environ.keys()
        bare.delenv(name)
    bare.setenv("VTK_DEFAULT_OPENGL_WINDOW", "vtkOSOpenGLRenderWindow")  # the user's choice stays
    plotter.prepare()
    assert os.environ["VTK_DEFAULT_OPENGL_WINDOW"] == "vtkOSOpenGLRenderWindow"
    bare.setattr(sys, "platform", "darwin")
    assert plotter.has_display()


def test_without_opengl_a_plotter_says_what_to_install(bare):
    runs = []

    def crash(*args, **kwargs):
        runs.append(args)
        return subprocess.CompletedProcess(args, -11, "", "")

    bare.setattr(subprocess, "run", crash)
    assert trouble()
    for make in (make_plotter, lambda: draw_view(some_camera(), print)):
        refused(make, "OpenGL", "status -11", "crashed", "apt-get install libegl1", error=RuntimeError)
    assert len(runs) == 1  # asked once


def test_draw_view_is_a_plotter_that_looks_through_the_camera_and_is_closed():
    camera, cloud, used = some_camera(), some_gaussians(), []
    with some_plotter() as window:
        add_cloud(window, cloud)
        look_through(window, camera)
        expected = window.screenshot(return_img=True)

    def draw(window):
        used.append(window)
        add_cloud(window, cloud)

    assert np.array_equal(draw_view(camera, draw, background="black"), expected)
    assert expected.any()
    assert (draw_view(camera, lambda window: None) == 255).all()

    def fail(window):
        used.append(window)
        raise KeyError("draw")

    refused(lambda: draw_view(camera, fail), "draw", error=KeyError)
    assert [window.render_window for window in used] == [None, None]


def test_pyvistas_theme_is_kept(monkeypatch):
    if trouble():
        pytest.skip(trouble())
    dark = pv.themes.DarkTheme().background
    monkeypatch.setattr(pv.global_theme, "background", dark)
    assert make_plotter(8, 8, off_screen=True).background_color == dark
    assert make_plotter(8, 8, off_screen=True, background="red").background_color == "red"
    pv.close_all()
