"""`explore`: open a field or a labelled splat in a window, a browser, a notebook, or as a picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Literal, get_args

from torch import Tensor

from .._check import check_choice
from .._typed import typed
from ..cameras import Camera
from ..formats import SplatFile
from ..gaussians import Gaussians
from ..labels import LabelSet
from ..viz.headless import has_display
from .desktop import open_window
from .explorer import Explorer
from .meaning import FieldMeaning, Meaning, SplatMeaning
from .options import ExploreOptions
from .state import Exploration
from .viewer import Viewer
from .widget import in_notebook, require_widget

if TYPE_CHECKING:
    from ..fields import SemanticField

Where = Literal["auto", "window", "browser", "notebook", "picture"]


@typed
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
) -> Explorer | Viewer:
    """Explore a scene: search by text, change gamma and lambda, pick and select Gaussians, edit, save.

    A selection in the semantic cloud also lights up in the colour cloud: each colour Gaussian takes the label of the
    nearest semantic one within lambda (Sec. 3.4). A window and a picture are drawn by pyvista, with both clouds side by side;
    everything is a method of the returned `Explorer`: `ask("chair")`, `set_gamma(0.6)`, `set_distance(0.05)`,
    `pick(x, y)`, `screenshot("chair.png")`, `save_selection()`. A page and a notebook are drawn by the browser: a `Viewer`,
    with `ask` and `save_html`.

    Args:
        source: a semantic field (search by text) or a labelled splat (search by class).
        color: the colour scene, in the same frame; None shows the source alone.
        classes: names and embeddings in the teacher's space; None: those that the field remembers. A splat has its own.
        cameras: views to search for those that see a picked Gaussian; empty: the field's own. A field without fused
            features computes them from these views. Without any view, it uses each Gaussian's own latent, which is noisy.
        embed: the teacher's text encoder, text -> [D], to search for more than the classes.
        distance: lambda, world units; None: from the clouds' spacing.
        where: `window` (blocks until you close it), `browser` (a page that only this machine can open; blocks until
            Ctrl-C), `notebook` (a widget, as the last value of a cell), or `picture` (opens nothing). `auto`: the notebook if
            there is one, else the browser if there is a display, else a picture.
        options: size, style, where files are saved.

    Raises:
        ValueError: if there is nothing to show, or arguments contradict each other.
        ImportError: if anywidget is missing for `notebook`.
        RuntimeError: if nothing can be drawn here, or there is no display for a window.
    """
    check_choice("where", where, get_args(Where))
    place = find_place() if where == "auto" else where
    check_place(place)
    if not isinstance(source, SplatFile) and not hasattr(source, "cosines"):
        raise TypeError(f"source: expected a SemanticField or a SplatFile, got {type(source).__name__}; pass one")
    if not cameras and not isinstance(source, SplatFile):
        cameras = source.cameras
    meaning = meaning_of(source, classes, cameras=cameras, embed=embed)
    cloud = color.gaussians if isinstance(color, SplatFile) else color
    state = Exploration(meaning, cloud, cameras=cameras, distance=distance)
    if place in ("browser", "notebook"):
        state.set_show(state.first_show)
        viewer = Viewer(state, options)
        if place == "browser":
            viewer.serve()
        return viewer
    explorer = Explorer(state, options, off_screen=place != "window")
    if place == "window":
        try:
            open_window(explorer)
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
    """Wrap a field (searched by text) or a labelled splat (searched by class).

    Raises:
        ValueError: if a field has no classes and none are given, or classes are given for a splat.
    """
    if isinstance(source, SplatFile):
        for name, given in (("classes", classes), ("embed", embed)):
            if given is not None:
                raise ValueError(
                    f"{name}: expected none with a splat, which has its own classes, got one; leave it out"
                )
        return SplatMeaning(source)
    return FieldMeaning(source, classes, cameras=cameras, embed=embed)


def find_place() -> Where:
    """Choose the value of `where` for "auto"."""
    if in_notebook():
        return "notebook"
    return "browser" if has_display() else "picture"


def check_place(place: Where) -> None:
    """Raise an ImportError or a RuntimeError if the browser page or a window is impossible here."""
    if place == "notebook":
        require_widget()
    if place == "window" and not has_display():
        raise RuntimeError(
            "where: expected a display for 'window', got none (neither DISPLAY nor WAYLAND_DISPLAY is set); use 'browser' or "
            "'picture'"
        )
