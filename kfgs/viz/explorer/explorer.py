"""The explorer: one state, one drawing, and the methods that a window, a page or a notebook calls."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable
from pathlib import Path
from threading import RLock
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from PIL import Image

from ..._check import check_choice
from ...cameras import Camera
from ...cameras.camera import NEAR
from ..camera_view import camera_of, letterboxed, look_through
from ..headless import make_plotter
from ..linked import look_over, upwards
from ..pictures import save_picture
from .drawing import Drawn, Pane
from .first_frame import FirstFrame
from .meaning import Asked
from .numbered_files import numbered_path
from .options import ExploreOptions, Style
from .picked import Picked, Side
from .state import Exploration, Show
from .while_open import while_open

if TYPE_CHECKING:
    import pyvista as pv

Array = np.ndarray[Any, Any]

NAMES: dict[Side, str] = {"semantic": "semantic field", "color": "colour field"}
WORDS: dict[Show, str] = {"labels": "classes", "rgb": "colours", "score": "scores", "latents": "latents"}
HIGHLIGHT = np.array((255, 120, 0))  # lies over a selection in its own colours, or a white sofa fades into the paper


class Explorer:
    """Both clouds side by side, and methods that change what is asked, shown and picked.

    Each method changes `state`, draws, and then calls the listeners. Nothing opens by itself: `plotter` draws with and
    without a display. Calls from several threads wait for each other, but OpenGL belongs to one thread: after the first
    picture, call the methods from the thread that drew it. A closed explorer raises a RuntimeError.

    Args:
        exploration: the state.
        options: size, style, where files are saved.
        camera: to look through first; None: the first of the state's, else everything but floaters is seen.
        off_screen: draw without a window; None: only where there is no display.

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
        self._at_close: list[Callable[[], None]] = []
        self._closed, self._listed = False, True
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
            self._style: Drawn = "points" if options.style == "points" else "gaussians"
            self._draw()
            count = sum(len(pane.cloud) for pane in self.panes)
            self._first = FirstFrame(self.plotter.render_window, count, self._to_points)
            self._choose_style(options.style)
        except BaseException:
            self.close()
            raise

    @while_open
    def ask(self, words: str | None) -> Asked | None:
        """Ask for a class or a phrase; what answers lights up, the rest is faint. None or "" drops the question.

        Raises:
            ValueError: for words that cannot be answered; the question of before stays.
        """
        self.state.ask(words)
        self._changed()
        return self.state.asked

    @while_open
    def set_gamma(self, gamma: float) -> None:
        """Select what scores above gamma.

        Raises:
            ValueError: if nothing is asked, or gamma is out of range.
        """
        self.state.set_gamma(gamma)
        self._changed()

    @while_open
    def set_distance(self, distance: float) -> None:
        """Let labels travel to colour Gaussians closer than this lambda, world units.

        Raises:
            ValueError: if it is not positive.
        """
        self.state.set_distance(distance)
        self._changed()

    @while_open
    def set_show(self, show: Show) -> None:
        """Choose what the colours stand for.

        Raises:
            ValueError: if it is unknown, or these clouds do not have it.
        """
        self.state.set_show(show)
        self._changed()

    @while_open
    def set_hidden(self, labels: Iterable[int | str]) -> None:
        """Hide classes, by label (-1: what has none) or by name; all others are drawn.

        Raises:
            ValueError: if there is no such class.
        """
        self.state.set_hidden(labels)
        self._changed()

    @while_open
    def set_style(self, style: Style) -> None:
        """Draw Gaussians or points; `auto`: points if a frame of Gaussians takes over 1 s.

        Raises:
            ValueError: if it is unknown.
        """
        check_choice("style", style, get_args(Style))
        self._style = "points" if style == "points" else "gaussians"
        self._draw()
        self._choose_style(style)
        self._changed()

    @property
    def style(self) -> Drawn:
        """How the clouds are drawn now."""
        return self._style

    @while_open
    def pick(self, x: float, y: float) -> Picked | None:
        """Point at what is seen at a place of the window; None (and no mark) where that is the background.

        What is clearly seen comes first; where nothing of it is, the faint rest answers.

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
        """Look through a posed camera: all that it sees, in its own proportions.

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
        """Look from where the first view was."""
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
        """The picture of now; with a path also as a PNG file."""
        listed = self._listed
        self.set_legend(True)
        try:
            self.plotter.render()  # pyvista's pictures are of the last frame
            picture: Array = np.array(self.plotter.screenshot(return_img=True))[..., :3]
        finally:
            self.set_legend(listed)
        if path is not None:
            save_picture(path, picture)
        return picture

    @while_open
    def save_picture(self) -> Path:
        """Write the picture of now as the next numbered file of `options.out`."""
        with numbered_path(self.options.out, "picture", ".png") as path:
            self.screenshot(path)
        return path

    @while_open
    def save_selection(self) -> list[Path]:
        """Write numbers and Gaussians of what is selected into the next numbered folder of `options.out`.

        Raises:
            ValueError: if nothing is selected.
        """
        with numbered_path(self.options.out, "selection") as folder:
            return self.state.save_selection(folder)

    def lines(self) -> list[str]:
        """What there is to say: the question, gamma, lambda, counts, what is picked."""
        picked = self.state.picked
        return self.state.lines() + ([] if picked is None else picked.lines())

    def set_legend(self, shown: bool) -> None:
        """List the classes in the panes, or not: a window or page that lists them itself. Pictures always do.

        Of a closed explorer it changes nothing: a face that ends may call it.
        """
        if shown != self._listed and not self.closed:
            self._listed = shown
            self._draw()

    def listen(self, callback: Callable[[], None]) -> None:
        """Have a function called after each change. It may call methods of the explorer, but not wait for other threads."""
        self._listeners.append(callback)

    @property
    def closed(self) -> bool:
        """Whether there is nothing to draw into any more."""
        return self._closed or self.plotter.render_window is None  # a desktop may destroy a window by itself

    def on_close(self, callback: Callable[[], None]) -> None:
        """Have a function called once, when the explorer is closed; at once if it is."""
        if self._closed:
            callback()
        else:
            self._at_close.append(callback)

    def close(self) -> None:
        """Free the window; a second time does nothing."""
        with self.lock:
            if self._closed:
                return
            self._closed = True
            self.plotter.close()
        while self._at_close:
            self._at_close.pop(0)()

    def __enter__(self) -> Explorer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Explorer{', closed' if self.closed else ''}: {'; '.join(self.state.lines())}>"

    def _repr_png_(self) -> bytes | None:
        if self.closed:
            return None  # a notebook shows the line above
        stream = io.BytesIO()
        Image.fromarray(self.screenshot()).save(stream, format="PNG")
        return stream.getvalue()

    def _changed(self) -> None:
        self._draw()
        self._tell()

    def _moved(self) -> None:
        for pane in self.panes:
            pane.renderer.camera_set = True  # or the first render would move it to see everything
            pane.renderer.ResetCameraClippingRange()
        self._tell()

    def _tell(self) -> None:
        if not self.plotter.off_screen:  # there a frame is drawn when somebody wants to see one
            self.plotter.render()  # nothing before the window is shown
        for callback in self._listeners:
            callback()

    def _draw(self) -> None:
        """Bring what is drawn up to the state, without a frame: pyvista draws one for each thing that is added."""
        with self.lock:  # a face may ask for it while another thread calls a method
            before = self.plotter.suppress_rendering
            self.plotter.suppress_rendering = True
            try:
                self._exchange()
            finally:
                self.plotter.suppress_rendering = before

    def _exchange(self) -> None:
        state, picked = self.state, self.state.picked
        for side, pane in zip(state.sides, self.panes, strict=True):
            selected = None if state.asked is None else state.selected(side)
            colors = state.colors(side)
            if selected is not None and state.show == "rgb":
                colors = np.where(selected[:, None], (colors + HIGHLIGHT) // 2, colors).astype(np.uint8)
            pane.draw(self._style, colors, state.drawn(side), selected, self.options.rest)
            pane.mark(None if picked is None else picked.position)
            words = "" if state.asked is None else f"{state.asked.words!r}, "
            labels = (
                sorted(state.present - state.hidden)
                if self._listed and state.show == "labels" and pane is self.panes[0]
                else []
            )
            clim = state.clim if state.show == "score" and pane is self.panes[-1] else None
            pane.say(f"{NAMES[side]}: {words}{WORDS[state.show]}", labels, state.meaning.names, clim)

    def _choose_style(self, style: Style) -> None:
        """Draw a frame to look at the clock, where "auto" is not sure; a window waits for its first frame."""
        self._first.waits = style == "auto"
        if self._first.waits and self._first.unsure and self.plotter.off_screen:
            self.screenshot()

    def _to_points(self) -> None:
        self._style = "points"
        self._draw()
