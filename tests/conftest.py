"""Shared fixtures: where the real data lies, and a headless-safe environment for every test."""

import faulthandler
import gc
import os
import signal
import sys
from pathlib import Path

import pytest

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch: two workers and the programs they start, a thread each
import torch

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command line does
if not os.environ.get("DISPLAY") and not os.environ.get("WAYLAND_DISPLAY"):
    os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")

if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # a shell's background job: programs of tests would inherit it
    signal.signal(signal.SIGINT, signal.default_int_handler)

gc.disable()  # until all tests are collected: nothing is garbage before


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config):
    """All tests run on two workers, unless -n says otherwise; a file or a test that is named, in this process.

    A worker that crashes ends the run and is named; else pytest-xdist would start it again and wait for it forever.
    """
    everything = config.args_source is config.ArgsSource.TESTPATHS and "PYTEST_XDIST_WORKER" not in os.environ
    if everything and not config.option.usepdb and getattr(config.option, "numprocesses", 0) is None:
        config.option.numprocesses, config.option.dist, config.option.maxworkerrestart = 2, "loadfile", "0"
        config.option.durations = 15


def pytest_collection_finish():
    """Millions of objects live until the end (modules, 5,000 tests): gc.collect() would look at them in every test."""
    gc.collect()
    gc.freeze()
    gc.enable()


@pytest.fixture(autouse=True)
def a_crash_says_where(pytestconfig):
    """pycolmap, when loaded, takes over pytest's handler of a segfault, and its message is lost in what pytest captures."""
    capture = pytestconfig.pluginmanager.getplugin("capturemanager")
    if "pycolmap" in sys.modules and capture is not None and not hasattr(pytestconfig, "kfgs_crashes"):
        with capture.global_and_fixture_disabled():
            pytestconfig.kfgs_crashes = os.dup(2)
        faulthandler.disable()
        faulthandler.enable(pytestconfig.kfgs_crashes)


@pytest.fixture
def notes():
    """What readers note ("a.ply: 3 of 5 Gaussians ..."), as a list that grows."""
    from kfgs._notes import hear

    heard = []
    with hear(heard.append):
        yield heard


def pytest_unconfigure():
    """Libraries that count their objects at the end find none left over."""
    gc.unfreeze()


SHARING = {  # files whose tests share what takes long to make: one worker runs them, and they begin first
    "kernels": ("tests/splat/cpu/", "tests/splat/test_engine", "tests/splat/test_ranks"),  # compiled once
    "interpreted": ("tests/splat/test_triton",),
    "stories": ("tests/stories/",),  # fields that are fitted once
    "pipeline": ("tests/pipeline/",),
}


def scope_of(nodeid):
    return next((scope for scope, files in SHARING.items() if nodeid.startswith(files)), None)


def pytest_collection_modifyitems(items):
    """What takes longest begins first, or one worker would be left with it in the end."""
    order = [*SHARING, None]
    items.sort(key=lambda item: order.index(scope_of(item.nodeid)))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """With `--dist loadfile`, files that share much are one worker's: two would make it twice."""
    if config.getvalue("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class ByFile(LoadFileScheduling):
        def _split_scope(self, nodeid):
            return scope_of(nodeid) or super()._split_scope(nodeid)

    config.option.loadscopereorder = False
    return ByFile(config, log)


SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(autouse=True)
def as_many_threads_as_before():
    """gsply, which reads what we wrote, lets OpenMP start a thread per core; the last bits depend on their number."""
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def room(tmp_path_factory) -> Path:
    """The small toy room on disk. No test changes it."""
    from small_room import make_room

    return make_room(tmp_path_factory.mktemp("desk") / "scene")


@pytest.fixture(scope="session")
def desk(room) -> Path:
    """The folder of the room, with what `small_room.make_desk` puts there. No test changes it."""
    from small_room import make_desk

    return make_desk(room.parent)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real scenes beside the project; the test is skipped where it is missing."""
    if not SHARED.is_dir():
        pytest.skip(f"needs the real scenes in {SHARED}, which are not part of the project")
    return SHARED
