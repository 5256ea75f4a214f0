"""The explorer: one state, one drawing, and the verbs that a window, a page or a notebook calls."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from time import perf_counter, process_time
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import torch
from PIL import Image

from ..._check import check_choice
from ...cameras import Camera
from ...cameras.camera import NEAR
from ...labels import class_indices
from ..headless import make_plotter
from ..linked import look_over
from ..pictures import save_picture
from ..through import camera_of, fitted, look_through
from ..turntable import estimate_up
from .drawing import Drawn, Pane
from .exploration import Exploration, Show
from .meaning import Asked
from .options import ExploreOptions, Style
from .pick import gaussian_at
from .picked import Picked, Side

if TYPE_CHECKING:
    import pyvista as pv

Array = np.ndarray[Any, Any]

NAMES: dict[Side, str] = {"semantic": "semantic field", "color": "colour field"}
WORDS: dict[Show, str] = {"labels": "classes", "rgb": "colours", "score": "scores", "latents": "latents"}
SLOW = 1.0  # seconds a frame from which "auto" draws points: a slider that follows later feels broken
SURE = 150_000  # Gaussians that "auto" draws without looking at the clock: half a second in software
HIGHLIGHT = np.array((255, 120, 0))  # lies over a selection in its own colours, or a white sofa fades into the paper


class Explorer:
    """Both clouds side by side, and verbs that change what is asked, shown and picked.

    Each verb changes `state`, draws, and then calls the listeners. Nothing opens by itself: `plotter` draws with and
    without a display.

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
        self._listeners: list[Callable[[], None]] = []
        self._closed, self._listed, self._began, self._auto = False, True, (0.0, 0.0), options.style == "auto"
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
            self.plotter.render_window.AddObserver("StartEvent", self._frame_begins)
            self.plotter.render_window.AddObserver("EndEvent", self._frame_ends)
            self._choose_style()
        except BaseException:
            self.close()
            raise

    def ask(self, words: str | None) -> Asked | None:
        """Ask for a class or a phrase; what answers lights up, the rest is faint. None or "" drops the question.

        Raises:
            ValueError: for words that cannot be answered; the question of before stays.
        """
        asked = self.state.ask(words)
        self._changed()
        return asked

    def set_gamma(self, gamma: float) -> None:
        """Select what scores above gamma.

        Raises:
            ValueError: if nothing is asked, or gamma is out of range.
        """
        self.state.set_gamma(gamma)
        self._changed()

    def set_distance(self, distance: float) -> None:
        """Let labels travel to colour Gaussians closer than this lambda, world units.

        Raises:
            ValueError: if it is not positive.
        """
        self.state.set_distance(distance)
        self._changed()

    def set_show(self, show: Show) -> None:
        """Choose what the colours stand for.

        Raises:
            ValueError: if it is unknown, or these clouds do not have it.
        """
        self.state.set_show(show)
        self._changed()

    def set_hidden(self, labels: Iterable[int | str]) -> None:
        """Hide classes, by label (-1: what has none) or by name; all others are drawn.

        Raises:
            ValueError: if there is no such class.
        """
        names = self.state.meaning.names
        hidden: list[int] = []
        for label in labels:
            hidden += class_indices(label, names) if isinstance(label, str) else [label]
        self.state.set_hidden(hidden)
        self._changed()

    def set_style(self, style: Style) -> None:
        """Draw Gaussians or points; `auto`: points if a frame of Gaussians takes over 1 s.

        Raises:
            ValueError: if it is unknown.
        """
        check_choice("style", style, get_args(Style))
        self._style, self._auto = "points" if style == "points" else "gaussians", style == "auto"
        self._draw()
        self._choose_style()
        self._changed()

    @property
    def style(self) -> Drawn:
        """How the clouds are drawn now."""
        return self._style

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
                camera = camera_of(self.plotter, (0, pane.column), near=self._near)
                for mask in (pane.visible, self.state.drawn(side)):
                    index = gaussian_at(pane.cloud, camera, *place, torch.from_numpy(mask))
                    if index is not None:
                        picked = self.state.pick(side, index)
                        break
        if picked is None:
            self.state.drop_pick()
        self._changed()
        return picked

    def look_from(self, camera: Camera) -> None:
        """Look through a posed camera: all that it sees, in its own proportions.

        Raises:
            ValueError: if its lens distorts.
        """
        width, height = self.panes[0].renderer.GetSize()
        self.plotter.subplot(0, 0)
        look_through(self.plotter, fitted(camera, height, width))
        if np.isclose(float(camera.K[0, 0]), float(camera.K[1, 1]), rtol=1e-6):
            self.plotter.camera.SetUseExplicitAspectRatio(False)  # the window may be resized
        self._moved()

    def reset_view(self) -> None:
        """Look from where the first view was."""
        if self._camera is not None:
            self.look_from(self._camera)
        else:
            self.plotter.subplot(0, 0)
            self.plotter.camera.SetUseExplicitAspectRatio(False)
            self.plotter.camera.SetWindowCenter(0, 0)
            look_over(self.plotter, self.state.cloud("semantic"), self._up())
            self._moved()

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

    def save_picture(self) -> Path:
        """Write the picture of now as the next numbered file of `options.out`."""
        path = self._next("picture", ".png")
        self.screenshot(path)
        return path

    def save_selection(self) -> list[Path]:
        """Write numbers and Gaussians of what is selected into the next numbered folder of `options.out`.

        Raises:
            ValueError: if nothing is selected.
        """
        return self.state.save_selection(self._next("selection", ""))

    def lines(self) -> list[str]:
        """What there is to say, for a person: the question, gamma, lambda, counts, what is picked."""
        picked = self.state.picked
        return self.state.lines() + ([] if picked is None else picked.lines())

    def set_legend(self, shown: bool) -> None:
        """List the classes in the panes, or not: a window or page that lists them itself. Pictures always do."""
        if shown != self._listed:
            self._listed = shown
            self._draw()

    def listen(self, callback: Callable[[], None]) -> None:
        """Have a function called after each change."""
        self._listeners.append(callback)

    def close(self) -> None:
        """Free the window; a second time does nothing."""
        if not self._closed:
            self._closed = True
            self.plotter.close()

    def __enter__(self) -> Explorer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _repr_png_(self) -> bytes:
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
            labels = self._present() if self._listed and state.show == "labels" and pane is self.panes[0] else []
            clim = state.clim if state.show == "score" and pane is self.panes[-1] else None
            pane.say(f"{NAMES[side]}: {words}{WORDS[state.show]}", labels, state.meaning.names, clim)

    def _present(self) -> list[int]:
        """The labels that are drawn on either side, ascending."""
        found = {int(label) for side in self.state.sides for label in np.unique(self.state.labels(side))}
        return sorted(found - self.state.hidden)

    def _up(self) -> list[float]:
        """The world's up as the cameras hold it, else z."""
        try:
            return [float(x) for x in estimate_up(self.state.cameras)]
        except ValueError:  # none, or not upright
            return [0.0, 0.0, 1.0]

    def _choose_style(self) -> None:
        """Draw a frame to look at the clock, where "auto" is not sure; a window waits for its first frame."""
        if self._auto and sum(len(pane.cloud) for pane in self.panes) > SURE and self.plotter.off_screen:
            self.screenshot()

    def _frame_begins(self, *_: Any) -> None:
        self._began = perf_counter(), process_time()

    def _frame_ends(self, *_: Any) -> None:
        """The first frame of "auto" decides what the next ones draw."""
        if not self._auto:
            return
        self._auto = False
        self.plotter.render_window.WaitForCompletion()
        wall, work = perf_counter() - self._began[0], process_time() - self._began[1]
        # in software all cores draw; other programs on them do not count
        if min(wall, work / (os.cpu_count() or 1)) > SLOW and sum(len(pane.cloud) for pane in self.panes) > SURE:
            self._style = "points"
            self._draw()

    def _next(self, stem: str, suffix: str) -> Path:
        taken = {path.stem for path in self.options.out.glob(f"{stem}_*")}
        number = next(i for i in range(1, len(taken) + 2) if f"{stem}_{i:03d}" not in taken)
        return self.options.out / f"{stem}_{number:03d}{suffix}"
