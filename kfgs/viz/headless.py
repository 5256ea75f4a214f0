"""Find out whether this machine can draw 3-D pictures (in another process, which may crash), and make plotters."""

from __future__ import annotations

import functools
import gc
import os
import subprocess
import sys
from typing import TYPE_CHECKING, Any, NamedTuple

from .._check import check_whole
from ..splat.engines import available_engines

if TYPE_CHECKING:
    import pyvista as pv

WINDOW_VARIABLE = "VTK_DEFAULT_OPENGL_WINDOW"
WITHOUT_DISPLAY = {WINDOW_VARIABLE: "vtkEGLRenderWindow", "PYVISTA_OFF_SCREEN": "true"}
DEBIAN_PACKAGES = "libegl1 libegl-mesa0 libgl1-mesa-dri"
PROBE_SECONDS = 120  # a first start of VTK from a cold disk takes tens of seconds
PROBE = """
import pyvista as pv
plotter = pv.Plotter(off_screen=True, window_size=(8, 8))
plotter.background_color = (255, 0, 0)
plotter.add_mesh(pv.Sphere(radius=0.01))
picture = plotter.screenshot(return_img=True)
plotter.close()
assert picture.shape == (8, 8, 3) and tuple(picture[0, 0]) == (255, 0, 0), picture
"""
_ours: set[str] = set()  # variables set here, not by the user


def has_display() -> bool:
    """Whether windows can be opened (Windows and macOS: always)."""
    if not sys.platform.startswith("linux"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


class Probe(NamedTuple):
    """Whether an 8 x 8 picture could be drawn, and the error if not."""

    works: bool
    reason: str


def prepare() -> None:
    """On Linux without a display, make VTK use EGL and pyvista draw off-screen. Without this VTK tries X and complains.

    Sets `VTK_DEFAULT_OPENGL_WINDOW=vtkEGLRenderWindow` and `PYVISTA_OFF_SCREEN=true` in this process if neither DISPLAY
    nor WAYLAND_DISPLAY is set. Values that are already set stay. If a display appeared since the last call (a virtual one,
    started by the program), the settings are removed again, in an imported pyvista too.

    Importing `kfgs.viz` calls it, and so does `make_plotter`. Call it yourself if your program starts a display later and
    makes windows without `make_plotter`.
    """
    if not sys.platform.startswith("linux"):
        return
    if not has_display():
        for name in WITHOUT_DISPLAY.keys() - os.environ.keys():
            os.environ[name] = WITHOUT_DISPLAY[name]
            _ours.add(name)
        return
    pyvista: Any = sys.modules.get("pyvista")
    if pyvista is not None and "PYVISTA_OFF_SCREEN" in _ours:
        pyvista.OFF_SCREEN = False  # read from the variable when it was imported
    while _ours:
        os.environ.pop(_ours.pop(), None)


@functools.cache
def probe() -> Probe:
    """Draw an 8 x 8 picture in another process, once: without an OpenGL driver VTK ends Python with a segfault."""
    prepare()
    try:
        result = subprocess.run(
            [sys.executable, "-c", PROBE], capture_output=True, text=True, timeout=PROBE_SECONDS, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return Probe(False, f"the trial picture did not finish ({error})")
    if result.returncode == 0:
        return Probe(True, "")
    if result.returncode < 0 or result.returncode == 139:  # killed by a signal, 139 = 128 + SIGSEGV through a shell
        return Probe(False, f"the trial picture crashed (exit status {result.returncode}): no OpenGL driver")
    last = (result.stderr.strip().splitlines() or ["no message"])[-1]
    return Probe(False, f"the trial picture failed ({last})")


def available() -> bool:
    """Whether 3-D pictures can be drawn here. The first call takes a second or two, later ones nothing."""
    return probe().works


def make_plotter(
    height: int = 768,
    width: int = 1024,
    *,
    shape: tuple[int, int] = (1, 1),
    off_screen: bool | None = None,
    background: str = "white",
) -> pv.Plotter:
    """A pyvista plotter that works with and without a display.

    Args:
        height: of the window, pixels.
        width: of the window, pixels.
        shape: (rows, columns) of subplots.
        off_screen: draw without a window; None: only where there is no display.
        background: a colour that pyvista knows.

    Raises:
        RuntimeError: if nothing can be drawn here; the message names the packages to install.
        ValueError: if a size is not positive.
    """
    check_whole("height", height, 1)
    check_whole("width", width, 1)
    hidden = not has_display() if off_screen is None else off_screen
    prepare()
    require()
    load_compilers()
    import pyvista as pv

    free_closed_windows()
    options: dict[str, Any] = {"shape": shape} if shape != (1, 1) else {}
    plotter = pv.Plotter(off_screen=hidden, window_size=(width, height), **options)
    plotter.set_background(background)
    return plotter


def free_closed_windows() -> None:
    """Free closed windows now, to avoid a segfault.

    pyvista's plotters lie in reference cycles. If Python's garbage collector frees the objects of a closed window between
    two renders of another one, Mesa's software driver can crash at the next render.
    """
    gc.collect()


@functools.cache
def load_compilers() -> None:
    """Load the rasteriser's engines before the first window is drawn, to avoid a segfault.

    Mesa's software driver loads its own LLVM. If pycolmap or a similar library is loaded too, loading the LLVM of numba or
    triton after Mesa's crashes Python (show a scene, then rasterise it). Loading it before Mesa's works. For plotters not
    made here, `kfgs.splat.engines.table` loads the engines with their own symbols.
    """
    available_engines("cpu")  # imports them


def require() -> None:
    """Raise a RuntimeError if nothing can be drawn here; VTK would crash."""
    found = probe()
    if not found.works:
        raise RuntimeError(
            f"3-D pictures cannot be drawn here: expected a working OpenGL, but {found.reason}; "
            f"on Debian or Ubuntu run: apt-get install {DEBIAN_PACKAGES}"
        )


prepare()  # before the user makes a plotter
