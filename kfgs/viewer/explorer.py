"""The explorer: a state, a plotter, and the methods that the window, the page and notebooks call."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable
from pathlib import Path
from threading import RLock
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from PIL import Image

from .._check import check_choice
from .._typed import typed
from ..cameras import Camera
from ..cameras.camera import NEAR
from ..viz.camera_view import camera_of, letterboxed, look_through
from ..viz.headless import make_plotter
from ..viz.linked import look_over, upwards
from ..viz.pictures import save_picture
from .drawing import Drawn, Pane
from .html import save_html
from .meaning import Asked
from .numbered_files import numbered_path
from .options import ExploreOptions, Style
from .picked import Picked, Side
from .state import Exploration, Show
from .while_open import while_open

if TYPE_CHECKING:
    import pyvista as pv

    from ..scenes import Scene

Array = np.ndarray[Any, Any]

SIDE_NAMES: dict[Side, str] = {"semantic": "semantic field", "color": "colour field"}
SHOW_NAMES: dict[Show, str] = {"labels": "classes", "rgb": "colours", "score": "scores", "latents": "latents"}
MANY = 150_000  # Gaussians: a frame of them takes half a second in software
HIGHLIGHT = np.array((255, 120, 0))  # tints a selection shown in its own colours: a white sofa is hard to see on white


@typed
class Explorer:
    """Both clouds side by side, with methods that change the question, the colours and the picked Gaussian.

    Each method changes `state`, draws, and then calls the listeners. Nothing opens by itself: `plotter` draws with and
    without a display. A lock makes calls from several threads wait for each other. But OpenGL works in one thread only:
    after the first picture, call the methods from the thread that drew it. A closed explorer raises a RuntimeError.

    Args:
        exploration: the state.
        options: size, style, where files are saved.
        camera: the first view; None: the first of the state's cameras, else a view of everything but floaters.
        off_screen: draw without a window; None: only if there is no display.

    Raises:
        ValueError: if the camera's lens distorts, or an option is out of range.
        RuntimeError: if nothing can be drawn here.
    """

    def __init__(
        self,
        exploration: Exploration,
        options: ExploreOptions = ExploreOptions(),  # noqa: B008  frozen
        *,
        camera: Camera | None = None,
        off_screen: bool | None = None,
    ) -> None:
        self.state, self.options = exploration, options
        self._camera = camera or next(iter(exploration.cameras), None)
        self._near = NEAR if self._camera is None else self._camera.near
        self.lock = RLock()
        self._listeners: list[Callable[[], None]] = []
        self._closed = False
        count = len(exploration.sides)
        self.plotter: pv.Plotter = make_plotter(
            options.height, options.width * count // 2, shape=(1, count), off_screen=off_screen,
            background=options.background,
        )  # fmt: skip
        try:
            self.panes = [
                Pane(self.plotter, column, exploration.cloud(side), self._near)
                for column, side in enumerate(exploration.sides)
            ]
            self.plotter.link_views()
            self.reset_view()
            self._style = self._drawn_as(options.style)
            self._draw()
        except BaseException:
            self.close()
            raise

    @while_open
    def ask(self, words: str | None) -> Asked | None:
        """Search for a class or a phrase: matching Gaussians stay bright, the rest become faint. None or "" clears the search.

        Raises:
            ValueError: if there is no answer to these words; the earlier question stays.
        """
        self.state.ask(words)
        self._changed()
        return self.state.asked

    @while_open
    def set_gamma(self, gamma: float) -> None:
        """Select the Gaussians that score above gamma.

        Raises:
            ValueError: if no question is asked, or gamma is out of range.
        """
        self.state.set_gamma(gamma)
        self._changed()

    @while_open
    def set_distance(self, distance: float) -> None:
        """Set lambda: colour Gaussians closer than this to a semantic one take its label. In world units, positive."""
        self.state.set_distance(distance)
        self._changed()

    @while_open
    def set_show(self, show: Show) -> None:
        """Choose what the colours mean: classes, own colours, scores or latents.

        Raises:
            ValueError: if it is unknown, or these clouds do not have it.
        """
        self.state.set_show(show)
        self._changed()

    @while_open
    def set_hidden(self, labels: Iterable[int | str]) -> None:
        """Hide these classes, by label (-1: no class) or name, and show all others.

        Raises:
            ValueError: if a class does not exist.
        """
        self.state.set_hidden(labels)
        self._changed()

    @while_open
    def set_style(self, style: Style) -> None:
        """Draw Gaussians or points; `auto`: points if there are more than 150,000."""
        check_choice("style", style, get_args(Style))
        self._style = self._drawn_as(style)
        self._changed()

    @property
    def style(self) -> Drawn:
        """How the clouds are drawn now."""
        return self._style

    @while_open
    def pick(self, x: float, y: float) -> Picked | None:
        """Pick the Gaussian seen at a pixel of the window; None, and no ring, for the background.

        Bright Gaussians come first; faint ones are picked only if there is no bright one.

        Args:
            x: pixels from the window's left edge.
            y: pixels from its top.
        """
        picked = None
        for side, pane in zip(self.state.sides, self.panes, strict=True):
            place = pane.within(x, y)
            if place is not None:
                index = pane.gaussian_at(camera_of(self.plotter, (0, pane.column), near=self._near), *place)
                picked = None if index is None else self.state.pick(side, index)
        if picked is None:
            self.state.drop_pick()
        self._changed()
        return picked

    @while_open
    def look_from(self, camera: Camera) -> None:
        """Look through a posed camera: its whole picture, at its aspect ratio.

        Raises:
            ValueError: if its lens distorts.
        """
        width, height = self.panes[0].renderer.GetSize()
        self.plotter.subplot(0, 0)
        look_through(self.plotter, letterboxed(camera, height, width))
        if np.isclose(float(camera.K[0, 0]), float(camera.K[1, 1]), rtol=1e-6):
            self.plotter.camera.SetUseExplicitAspectRatio(False)  # the window may be resized
        self._moved()

    @while_open
    def reset_view(self) -> None:
        """Go back to the first view."""
        if self._camera is not None:
            self.look_from(self._camera)
        else:
            self.plotter.subplot(0, 0)
            self.plotter.camera.SetUseExplicitAspectRatio(False)
            self.plotter.camera.SetWindowCenter(0, 0)
            look_over(self.plotter, self.state.cloud("semantic"), upwards(self.state.cameras))
            self._moved()

    @while_open
    def screenshot(self, path: str | Path | None = None) -> Array:  # [H, W, 3] uint8
        """Take a picture of the current view, with a legend; with a path, also write it as a PNG file."""
        self.plotter.render()  # pyvista takes its pictures from the last frame
        picture: Array = np.array(self.plotter.screenshot(return_img=True))[..., :3]
        if path is not None:
            save_picture(path, picture)
        return picture

    @while_open
    def save_picture(self) -> Path:
        """Write the current view as the next numbered file of `options.out`."""
        with numbered_path(self.options.out, "picture", ".png") as path:
            self.screenshot(path)
        return path

    @while_open
    def save_selection(self) -> list[Path]:
        """Write the selection (numbers and Gaussians) into the next numbered folder of `options.out`.

        Raises:
            ValueError: if nothing is selected.
        """
        with numbered_path(self.options.out, "selection") as folder:
            return self.state.save_selection(folder)

    def save_html(self, path: str | Path, *, title: str = "kfgs", scene: Scene | None = None) -> Path:
        """Write one file with the scene and a viewer, which opens in any browser, offline. See `save_html`.

        Raises:
            ValueError: if the name does not end in .html.
        """
        with self.lock:
            return save_html(self.state, path, title=title, scene=scene)

    def lines(self) -> list[str]:
        """The status as lines of text: question, gamma, lambda, counts, picked Gaussian."""
        picked = self.state.picked
        return self.state.lines() + ([] if picked is None else picked.lines())

    def listen(self, callback: Callable[[], None]) -> None:
        """Call a function after each change. It may call the explorer's methods, but must not wait for other threads."""
        self._listeners.append(callback)

    @property
    def closed(self) -> bool:
        """Whether the explorer or its window is closed."""
        return self._closed or self.plotter.render_window is None  # the desktop can destroy a window

    def close(self) -> None:
        """Close the window; a second call does nothing."""
        with self.lock:
            if self._closed:
                return
            self._closed = True
            self.plotter.close()

    def __enter__(self) -> Explorer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Explorer{', closed' if self.closed else ''}: {'; '.join(self.state.lines())}>"

    def _repr_png_(self) -> bytes | None:
        if self.closed:
            return None  # the notebook shows __repr__ instead
        stream = io.BytesIO()
        Image.fromarray(self.screenshot()).save(stream, format="PNG")
        return stream.getvalue()

    def _changed(self) -> None:
        self._draw()
        self._notify()

    def _moved(self) -> None:
        for pane in self.panes:
            pane.renderer.camera_set = True  # otherwise the first render moves the camera to see everything
            pane.renderer.ResetCameraClippingRange()
        self._notify()

    def _notify(self) -> None:
        for callback in self._listeners:
            callback()
        if not self.plotter.off_screen:  # off-screen, a frame is drawn only when a picture is needed
            self.plotter.render()  # does nothing before the window is shown

    def _draw(self) -> None:
        """Update the actors from the state, without rendering: pyvista would render after each actor added."""
        with self.lock:  # a window or page may draw while another thread calls a method
            before = self.plotter.suppress_rendering
            self.plotter.suppress_rendering = True
            try:
                self._update_panes()
            finally:
                self.plotter.suppress_rendering = before

    def _update_panes(self) -> None:
        state, picked = self.state, self.state.picked
        for side, pane in zip(state.sides, self.panes, strict=True):
            selected = None if state.asked is None else state.selected(side)
            colors = state.colors(side)
            if selected is not None and state.show == "rgb":
                colors = np.where(selected[:, None], (colors + HIGHLIGHT) // 2, colors).astype(np.uint8)
            pane.draw(self._style, colors, state.drawn(side), selected, self.options.rest)
            pane.ring.move(None if picked is None else picked.position)
            question = "" if state.asked is None else f"{state.asked.words!r}, "
            has_legend = state.show == "labels" and pane is self.panes[0]
            labels = sorted(state.present - state.hidden) if has_legend else []
            clim = state.clim if state.show == "score" and pane is self.panes[-1] else None
            pane.annotate(f"{SIDE_NAMES[side]}: {question}{SHOW_NAMES[state.show]}", labels, state.meaning.names, clim)

    def _drawn_as(self, style: Style) -> Drawn:
        many = sum(len(pane.cloud) for pane in self.panes) > MANY
        return "points" if style == "points" or (style == "auto" and many) else "gaussians"
