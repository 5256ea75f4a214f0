import gc
import os
import subprocess
import sys
import weakref
from types import SimpleNamespace

import pytest
from cases_window import an_explorer
from kfgs.viewer.serving import has_display
from messages import tells

from kfgs.viz import available, headless, make_plotter

VARIABLES = ("DISPLAY", "WAYLAND_DISPLAY", *headless.WITHOUT_DISPLAY)


@pytest.fixture
def bare(monkeypatch):
    """A Linux without a display, and nothing probed yet; the environment comes back afterwards."""
    for name in VARIABLES:
        monkeypatch.setenv(name, "to be restored")
        monkeypatch.delenv(name)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(headless, "_ours", set())
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
        assert not headless.WITHOUT_DISPLAY.keys() & os.environ.keys()
        bare.delenv(name)


def test_a_window_chosen_by_the_user_stays(bare):
    bare.setenv(headless.WINDOW_VARIABLE, "vtkOSOpenGLRenderWindow")
    headless.prepare()
    assert os.environ[headless.WINDOW_VARIABLE] == "vtkOSOpenGLRenderWindow"
    bare.setenv("DISPLAY", ":0")
    headless.prepare()
    assert os.environ[headless.WINDOW_VARIABLE] == "vtkOSOpenGLRenderWindow"


def test_the_choice_is_taken_back_when_a_display_comes(bare):
    headless.prepare()
    assert {name: os.environ[name] for name in headless.WITHOUT_DISPLAY} == headless.WITHOUT_DISPLAY
    bare.setenv("DISPLAY", ":99")
    headless.prepare()
    assert not headless.WITHOUT_DISPLAY.keys() & os.environ.keys()


def test_pyvista_opens_windows_again_when_a_display_comes(bare):
    headless.prepare()
    pyvista = SimpleNamespace(OFF_SCREEN=True)  # as imported now
    bare.setitem(sys.modules, "pyvista", pyvista)
    headless.prepare()
    assert pyvista.OFF_SCREEN
    bare.setenv("DISPLAY", ":99")
    headless.prepare()
    assert not pyvista.OFF_SCREEN
    pyvista.OFF_SCREEN = True  # by the user
    headless.prepare()
    assert pyvista.OFF_SCREEN


def test_other_systems_are_left_alone(bare):
    bare.setattr(sys, "platform", "darwin")
    headless.prepare()
    assert headless.WINDOW_VARIABLE not in os.environ
    assert has_display()


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
    with pytest.raises(ValueError, match=tells(f"{name}:", f"got {min(height, width)}")):
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


BARE = {key: value for key, value in os.environ.items() if key not in VARIABLES}
CLOUD = """
import torch
from kfgs.gaussians import Gaussians
gaussians = Gaussians(torch.rand(9, 3), torch.ones(9, 4), torch.full((9, 3), 0.1), torch.full((9,), 0.5),
    labels=torch.arange(9) % 3)
"""


def run_bare(program, **environment):
    """In a Python of its own, as on a machine without a display that nobody has prepared."""
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", program], capture_output=True, text=True, check=False, timeout=600,
        env=BARE | environment,
    )  # fmt: skip


@pytest.fixture(scope="module")
def looked():
    """With pycolmap loaded, an LLVM (numba's) loaded after that of Mesa's driver ended Python with a segfault."""
    if not available():
        pytest.skip(headless.probe().reason)
    return run_bare(f"""
import pycolmap
from kfgs.viz import linked_clouds
{CLOUD}
plotter = linked_clouds(gaussians, gaussians, color_by=("label", "opacity"), height=60)
assert plotter.screenshot(return_img=True).std() > 0
import llvmlite.binding
plotter.show()
print("shown")
""")


def test_rasterising_after_a_picture_does_not_crash(looked):
    assert looked.returncode == 0, looked.stderr


def test_without_a_display_nothing_is_printed_and_show_returns(looked):
    assert (looked.returncode, looked.stdout, looked.stderr) == (0, "shown\n", "")


def test_a_plotter_of_the_users_own_is_silent_and_does_not_keep_one_from_rasterising():
    """pycolmap and Mesa's LLVM are there before numba's and triton's, which ended in a segfault."""
    if not available():
        pytest.skip(headless.probe().reason)
    program = f"""
import pycolmap
from kfgs.viz import add_cloud
import pyvista
{CLOUD}
plotter = pyvista.Plotter(window_size=(64, 48))
add_cloud(plotter, gaussians, style="gaussians")
assert plotter.screenshot(return_img=True).std() > 0
import sys
assert not {{"numba", "triton"}} & set(sys.modules), "too early to tell anything"
from kfgs.splat.engines import available_engines
print(*available_engines("cpu"))
plotter.show()
"""
    done = run_bare(program)
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    assert "reference" in done.stdout


def test_a_missing_driver_is_told_by_every_entry():
    """libglvnd finds no vendor's EGL: VTK alone would end Python, or warn and draw nothing."""
    if not sys.platform.startswith("linux"):
        pytest.skip("drivers are hidden by variables of Linux's EGL")
    program = f"""
import numpy
from kfgs.viz import available, linked_clouds, make_plotter
from kfgs.viewer import explore
from kfgs.viewer.state import Exploration
from kfgs.viewer.explorer import Explorer
from kfgs.viewer.meaning import SplatMeaning
{CLOUD}
splats = SplatFile(gaussians, {{}}, ("a", "b", "c"))
assert not available()
for entry in (
    make_plotter,
    lambda: linked_clouds(gaussians, gaussians),
    lambda: Explorer(Exploration(SplatMeaning(splats))),
    lambda: explore(splats),
    lambda: explore(splats, where="picture"),
):
    try:
        entry()
    except RuntimeError as error:
        print("install libegl1 libegl-mesa0 libgl1-mesa-dri" in str(error), "cannot be drawn here" in str(error))
"""
    hidden = {name: "/nonexistent" for name in ("__EGL_VENDOR_LIBRARY_FILENAMES", "LIBGL_DRIVERS_PATH")}
    done = run_bare(program, **hidden)
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    assert done.stdout == "True True\n" * 5


@pytest.mark.skipif(not available(), reason=headless.probe().reason)
def test_a_closed_window_is_freed_before_the_next_is_made():
    """Freed between two renders of the next one, it has crashed Mesa."""
    gc.disable()
    try:
        with an_explorer() as explorer:
            explorer.screenshot()
            window = weakref.ref(explorer.plotter)
            ring = [explorer.plotter]
            ring.append(ring)  # a cycle, as users' callbacks make them
        del explorer, ring
        assert window() is not None
        make_plotter(20, 30, off_screen=True).close()
        assert window() is None
    finally:
        gc.enable()
