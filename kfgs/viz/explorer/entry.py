"""One call from a field to looking at it: in a window, in the browser, in a notebook, or as a picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Literal, get_args

from torch import Tensor

from ..._check import check_choice
from ...cameras import Camera
from ...formats import SplatFile
from ...gaussians import Gaussians
from ...labels import LabelSet
from ..headless import has_display
from .desktop import open_window
from .explorer import Explorer
from .meaning import FieldMeaning, Meaning, SplatMeaning
from .notebook import close_earlier, in_notebook, show_in_notebook
from .options import ExploreOptions
from .state import Exploration
from .web import require_web, serve

if TYPE_CHECKING:
    from ...fields import SemanticField

Where = Literal["auto", "window", "browser", "notebook", "picture"]


def explore(
    source: SemanticField | SplatFile,
    color: Gaussians | SplatFile | None = None,
    *,
    classes: LabelSet | None = None,
    cameras: Sequence[Camera] = (),
    embed: Callable[[str], Tensor] | None = None,
    distance: float | None = None,
    where: Where = "auto",
    options: ExploreOptions = ExploreOptions(),  # noqa: B008  frozen
) -> Explorer:
    """Look at what a scene means: ask for words, move gamma and lambda, pick Gaussians, save what was found.

    The semantic cloud is on the left, the colour cloud on the right; what is selected on the left lights up on the right
    through lambda (Sec. 3.4). Everything that can be clicked can also be called on the explorer that comes back:
    `ask("chair")`, `set_gamma(0.6)`, `set_distance(0.05)`, `pick(x, y)`, `screenshot("chair.png")`, `save_selection()`.

    Args:
        source: a semantic field, asked by text; or a labelled splat, asked by class.
        color: the colour scene, in the same frame; None shows the source alone.
        classes: names and embeddings in the teacher's space; None: those that the field remembers. None for a splat, which
            has its own.
        cameras: views among which those that see a picked Gaussian are named; None given: the field's own. A field without
            fused features finds them from these views; without any each Gaussian's own latent decides, which is noisy.
        embed: the teacher's text encoder, word -> [D], to ask for more than the classes.
        distance: lambda, world units; None: from the clouds' spacing.
        where: `window` (blocks until it is closed), `browser` (a page that only this machine can open; blocks until
            Ctrl-C), `notebook` (the page within the cell, or a picture and the line to install where the extra `web` is
            missing; running the cell again closes the explorer that it made before), `picture` (nothing opens; in a
            notebook the explorer shows as a picture). `auto`: the notebook if there is one, else a window where there is
            a display, else a picture.
        options: size, style, where files are saved.

    Returns:
        The explorer.

    Raises:
        ValueError: if there is nothing to look at, or arguments contradict each other.
        ImportError: if `browser` is asked for and the extra `web` is missing, or `notebook` and IPython is.
        RuntimeError: if nothing can be drawn here, or a window is asked for and there is no display.
    """
    check_choice("where", where, get_args(Where))
    place = find_place() if where == "auto" else where
    check_place(place)
    if not cameras and not isinstance(source, SplatFile):
        cameras = source.cameras
    meaning = meaning_of(source, classes, cameras=cameras, embed=embed)
    cloud = color.gaussians if isinstance(color, SplatFile) else color
    state = Exploration(meaning, cloud, cameras=cameras, distance=distance)
    explorer = Explorer(state, options, off_screen=place != "window")
    try:
        show(explorer, place)
    except BaseException:
        explorer.close()
        raise
    return explorer


def meaning_of(
    source: SemanticField | SplatFile,
    classes: LabelSet | None = None,
    *,
    cameras: Sequence[Camera] = (),
    embed: Callable[[str], Tensor] | None = None,
) -> Meaning:
    """What can be asked of a field (by text) or a labelled splat (by class).

    Raises:
        ValueError: if classes are neither given for a field nor remembered by it, or are given beside a splat.
    """
    if isinstance(source, SplatFile):
        for name, given in (("classes", classes), ("embed", embed)):
            if given is not None:
                raise ValueError(
                    f"{name}: expected none beside a splat, which has its own classes, got one; leave it out"
                )
        return SplatMeaning(source)
    return FieldMeaning(source, classes, cameras=cameras, embed=embed)


def find_place() -> Where:
    """The notebook where there is one, else a window where there is a display, else a picture."""
    if in_notebook():
        return "notebook"
    return "window" if has_display() else "picture"


def check_place(place: Where) -> None:
    """Refuse a place that is not there, before anything is computed.

    Raises:
        ImportError: if the browser's page is asked for and the extra `web` is missing.
        RuntimeError: if a window is asked for and there is no display.
    """
    if place == "browser":
        require_web()
    if place == "window" and not has_display():
        raise RuntimeError(
            "where: expected a display for 'window', got none (neither DISPLAY nor WAYLAND_DISPLAY is set); use 'browser' or "
            "'picture'"
        )


def show(explorer: Explorer, place: Where) -> None:
    """Open an explorer's face; a picture needs none."""
    if place == "window":
        open_window(explorer)
    elif place == "browser":
        serve(explorer)
    elif place == "notebook":
        close_earlier(explorer)
        show_in_notebook(explorer)
