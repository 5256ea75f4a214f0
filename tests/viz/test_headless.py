import os
import subprocess
import sys

import pytest

from kfgs.viz import available, headless, make_plotter

VARIABLES = ("DISPLAY", "WAYLAND_DISPLAY", headless.WINDOW_VARIABLE)


@pytest.fixture
def bare(monkeypatch):
    """A Linux without a display, and nothing probed yet; the environment comes back afterwards."""
    for name in VARIABLES:
        monkeypatch.setenv(name, "to be restored")
        monkeypatch.delenv(name)
    monkeypatch.setattr(sys, "platform", "linux")
    headless.probe.cache_clear()
    yield monkeypatch
    headless.probe.cache_clear()


def test_egl_is_chosen_only_without_any_display(bare):
    headless.prepare()
    assert os.environ[headless.WINDOW_VARIABLE] == "vtkEGLRenderWindow"
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        bare.delenv(headless.WINDOW_VARIABLE, raising=False)
        bare.setenv(name, ":0")
        headless.prepare()
        assert headless.WINDOW_VARIABLE not in os.environ
        bare.delenv(name)


def test_a_window_chosen_by_the_user_stays(bare):
    bare.setenv(headless.WINDOW_VARIABLE, "vtkOSOpenGLRenderWindow")
    headless.prepare()
    assert os.environ[headless.WINDOW_VARIABLE] == "vtkOSOpenGLRenderWindow"


def test_other_systems_are_left_alone(bare):
    bare.setattr(sys, "platform", "darwin")
    headless.prepare()
    assert headless.WINDOW_VARIABLE not in os.environ
    assert headless.has_display()


def test_probe_runs_once_in_another_process(bare):
    calls = []

    def run(command, **options):
        calls.append((command[0], os.environ.get(headless.WINDOW_VARIABLE)))
        return subprocess.CompletedProcess(command, 0, "", "")

    bare.setattr(subprocess, "run", run)
    assert available()
    assert available()
    assert calls == [(sys.executable, "vtkEGLRenderWindow")]


def run_probe(bare, program):
    bare.setattr(headless, "PROBE", program)
    assert not available()
    with pytest.raises(RuntimeError) as error:
        make_plotter()
    return str(error.value)


def test_a_crash_is_survived_and_the_packages_are_named(bare):
    message = run_probe(bare, "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    assert "no OpenGL driver" in message
    assert "apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri" in message


def test_a_failure_is_quoted(bare):
    assert "ValueError: odd picture" in run_probe(bare, "raise ValueError('odd picture')")


def test_a_hang_ends(bare):
    bare.setattr(headless, "PROBE_SECONDS", 0.2)
    assert "did not finish" in run_probe(bare, "import time; time.sleep(30)")


@pytest.mark.parametrize(("height", "width", "name"), [(0, 5, "height"), (5, -1, "width")])
def test_size_must_be_positive(height, width, name):
    with pytest.raises(ValueError, match=f"{name}: expected a number in"):
        make_plotter(height, width)


def test_plotter_has_the_asked_size_and_subplots():
    if not available():
        pytest.skip(headless.probe().reason)
    plotter = make_plotter(60, 90, shape=(1, 2), off_screen=True)
    try:
        assert plotter.window_size == [90, 60]
        assert plotter.shape == (1, 2)
        assert plotter.screenshot(return_img=True).shape == (60, 90, 3)
    finally:
        plotter.close()


def test_rasterising_after_a_picture_does_not_crash():
    """With pycolmap loaded, an LLVM (numba's) loaded after that of Mesa's driver ended Python with a segfault."""
    if not available():
        pytest.skip(headless.probe().reason)
    program = """
import pycolmap
from kfgs.viz import make_plotter
plotter = make_plotter(8, 8, off_screen=True)
plotter.screenshot(return_img=True)
import llvmlite.binding
plotter.close()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
