"""Both clouds side by side in pyvista: as a picture, or in a desktop window with sliders and keys."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from math import log10
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .._card import error_line
from .._check import as_array
from .._files import as_path
from .._origin import to_world
from ..cameras import Camera
from ..cameras.camera import NEAR
from ..viz.clouds import add_cloud, recolor_cloud
from ..viz.colors import COLORMAP, Array
from ..viz.legends import add_legend, add_title, letters
from ..viz.linked import look_over, upwards
from ..viz.pictures import save_picture
from ..viz.plotter import camera_of, has_display, look_through, make_plotter
from .meaning import Asked
from .picking import gaussian_at
from .session import labelled, save_selection
from .state import SIDE_WORDS, Exploration, Show, Side

SIDE_NAMES: dict[Side, str] = {"semantic": "semantic field", "color": "colour field"}
SHOW_NAMES: dict[Show, str] = {"labels": "classes", "rgb": "colours", "score": "scores", "latents": "latents"}
MANY = 150_000  # Gaussians: a frame of them takes half a second in software; more are drawn as points
REST = 0.04  # factor on the opacity of Gaussians that are not selected; points fade to almost white instead
HIGHLIGHT = np.array((255, 120, 0))  # tints a selection shown in its own colours: a white sofa is hard to see on white
KEYS = """n, N  next, previous class    Esc  no class    {shows}
r  first view    p  save the picture    s  save the selection    q  close"""


@dataclass(frozen=True)
class Picked:
    """A picked Gaussian."""

    side: Side
    index: int
    name: str  # its class
    score: float  # for the question, or of its label without one; NaN if unknown
    position: tuple[float, float, float]  # in the world


class Explorer:
    """The clouds of an exploration in pyvista, with methods that change its question, thresholds and colours, and draw.

    Nothing opens by itself: `plotter` draws with and without a display, and `show` opens a window. `out` is the folder for
    saved pictures and selections, `height` is in pixels.
    """

    def __init__(
        self,
        exploration: Exploration,
        *,
        out: str | Path = "kfgs_view",
        height: int = 600,
        off_screen: bool | None = None,
    ) -> None:
        self.state, self.out = exploration, as_path(out)
        sides = exploration.sides
        self._near = exploration.cameras[0].near if exploration.cameras else NEAR
        many = sum(len(exploration.cloud(side)) for side in sides) > MANY
        self.style = "points" if many else "gaussians"
        self.plotter: Any = make_plotter(height, height * len(sides), shape=(1, len(sides)), off_screen=off_screen)
        self._notes: list[Any] = []
        self._picked: Picked | None = None
        self._actors = []
        for column, side in enumerate(sides):
            self.plotter.subplot(0, column)
            colors, cloud = exploration.colors(side), exploration.cloud(side)
            actor = add_cloud(self.plotter, cloud, color_by=colors, style=self.style, near=self._near)  # type: ignore[arg-type]
            self._actors.append(actor)
        self.plotter.link_views()
        self.look_from(exploration.cameras[0] if exploration.cameras else None)
        self._draw()

    def ask(self, words: str | None) -> Asked | None:
        """Search for a class or a phrase: matching Gaussians stay bright, the rest become faint. None clears the search."""
        self.state.ask(words)
        self._draw()
        return self.state.asked

    def set_gamma(self, gamma: float) -> None:
        """Select the Gaussians that score above gamma."""
        self.state.set_gamma(gamma)
        self._draw()

    def set_distance(self, distance: float) -> None:
        """Set lambda, in world units: colour Gaussians closer than this to a semantic one take its label."""
        self.state.set_distance(distance)
        self._draw()

    def set_show(self, show: Show) -> None:
        """Choose what the colours mean: `labels`, `rgb`, `score` or `latents`."""
        self.state.set_show(show)
        self._draw()

    def pick(self, x: float, y: float) -> Picked | None:
        """Pick the Gaussian seen at a pixel of the window (y from its top), a selected one first; None: background."""
        state, self._picked = self.state, None
        width = self.plotter.window_size[0] // len(state.sides)
        column = min(int(x // width), len(state.sides) - 1)
        side = state.sides[column]
        camera = camera_of(self.plotter, (0, column), near=self._near)
        masks = [torch.from_numpy(state.selected(side)), None] if state.asked else [None]
        seen = (gaussian_at(state.cloud(side), camera, x - width * column, y, mask) for mask in masks)
        index = next((index for index in seen if index is not None), None)
        if index is not None:
            cloud, label = state.cloud(side), int(state.labels(side)[index])
            place = to_world(cloud.means[index], cloud.origin).tolist()
            name = state.meaning.names[label] if label >= 0 else "no class"
            self._picked = Picked(side, index, name, float(state.scores(side)[index]), tuple(place))
        self._draw()
        return self._picked

    def look_from(self, camera: Camera | None) -> None:
        """Look through a posed camera: its whole picture, at its aspect ratio; None: at everything but floaters."""
        self.plotter.subplot(0, 0)
        if camera is None:
            look_over(self.plotter, upwards(self.state.cameras))
            return
        width, height = self.plotter.window_size
        width //= len(self.state.sides)
        look_through(self.plotter, camera.to("cpu", torch.float64).letterboxed(height, width))
        if np.isclose(float(camera.K[0, 0]), float(camera.K[1, 1]), rtol=1e-6):
            self.plotter.camera.SetUseExplicitAspectRatio(False)  # the window may be resized
        for renderer in self.plotter.renderers:
            renderer.camera_set = True  # otherwise the first render moves the camera to see everything
            renderer.ResetCameraClippingRange()

    def screenshot(self, path: str | Path | None = None) -> Array:  # [H, W, 3] uint8
        """Take a picture of the current view, with a legend, and write it as a PNG file if there is a path."""
        self.plotter.render()  # pyvista takes its pictures from the last frame
        picture: Array = np.array(self.plotter.screenshot(return_img=True))[..., :3]
        if path is not None:
            save_picture(path, picture)
        return picture

    def save_selection(self) -> list[Path]:
        """Write the selection (numbers and Gaussians) into the next numbered folder of `out`."""
        masks = {side: torch.from_numpy(self.state.selected(side)) for side in self.state.sides}
        return save_selection(self.state, {side: labelled(self.state, side) for side in masks}, masks, self.out)

    def lines(self) -> list[str]:
        """The status as lines of text: question, gamma, lambda, counts, picked Gaussian."""
        picked = self._picked
        if picked is None:
            return self.state.lines()
        place = ", ".join(f"{x:.3f}" for x in picked.position)
        where = f"{SIDE_WORDS[picked.side]} Gaussian {picked.index}"
        return [*self.state.lines(), f"{where}: {picked.name}, score {picked.score:.3f}, at ({place})"]

    def show(self) -> None:
        """Open a window until the user closes it: sliders for gamma and lambda, a click picks, a drag turns, keys do the rest.

        pyvista has no text field: to search for a phrase, call `ask` first. A RuntimeError if there is no display.
        """
        if not has_display() or self.plotter.off_screen:
            self.close()
            raise RuntimeError("where: expected a display for a window, got none; use 'browser' or 'picture'")
        _Controls(self)
        self.plotter.show(title="kfgs")

    def close(self) -> None:
        """Close the window; a second call does nothing."""
        self.plotter.close()

    def __enter__(self) -> Explorer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _draw(self) -> None:
        """Bring colours, opacities, titles and legends up to date, and render once."""
        state, plotter = self.state, self.plotter
        plotter.suppress_rendering = True
        for note in self._notes:
            plotter.remove_actor(note, render=False)
        self._notes = []
        if "score" in plotter.scalar_bars:
            plotter.remove_scalar_bar("score", render=False)
        for column, side in enumerate(state.sides):
            plotter.subplot(0, column)
            colors, opacities = state.colors(side), as_array(state.cloud(side).opacities)
            if state.asked is not None:
                rest = ~state.selected(side)
                if state.show == "rgb":
                    colors = np.where(rest[:, None], colors, (colors + HIGHLIGHT) // 2).astype(np.uint8)
                if self.style == "points":
                    colors[rest] = 215 + colors[rest] // 8
                opacities = np.where(rest, REST * opacities, opacities)
            recolor_cloud(self._actors[column], colors, None if self.style == "points" else opacities)
            question = "" if state.asked is None else f"{state.asked.words!r}, "
            self._notes.append(add_title(plotter, f"{SIDE_NAMES[side]}: {question}{SHOW_NAMES[state.show]}"))
            if state.show == "labels" and column == 0:
                self._notes.append(add_legend(plotter, labelled(state, side)))
            if state.show == "score" and column == len(state.sides) - 1:
                scale = self._actors[column].mapper  # whose colours are given: its own table would not be used
                scale.lookup_table.apply_cmap(COLORMAP)
                scale.scalar_range = state.clim
                plotter.add_scalar_bar(
                    "score", mapper=scale, vertical=True, n_labels=5, fmt="%.3g", color=letters(plotter), title_font_size=14,
                    label_font_size=14, position_x=0.88, position_y=0.05, width=0.08, height=0.5, render=False,
                )  # fmt: skip
            if self._picked is not None and self._picked.side == side:
                place = as_array(state.cloud(side).means[self._picked.index])[None]
                options = {"always_visible": True, "point_size": 10, "point_color": "red", "reset_camera": False}
                self._notes.append(plotter.add_point_labels(place, [self._picked.name], **options))
        plotter.subplot(0, 0)
        plotter.suppress_rendering = False
        if not plotter.off_screen:
            plotter.render()  # does nothing before the window is shown


class _Controls:
    """Sliders, a text and keys in an explorer's plotter; they call the explorer's methods."""

    def __init__(self, explorer: Explorer) -> None:
        self.explorer, self.plotter = explorer, explorer.plotter
        self.pressed: tuple[int, int] | None = None  # where the mouse was pressed
        last = len(explorer.state.sides) - 1
        self.plotter.subplot(0, last)
        ink = letters(self.plotter)
        self.text: Any = self.plotter.add_text("", position=(0.012, 0.93), viewport=True, font_size=7, color=ink)
        self.text.prop.justification_vertical = "top"
        self.plotter.subplot(0, 0)  # in another subplot, VTK looks for the mouse in the wrong place
        self.sliders = {"gamma": self._slider(0.13, explorer.set_gamma)}
        if last:
            self.sliders["lambda"] = self._slider(0.06, lambda x: explorer.set_distance(10**x))
        state = explorer.state
        actions: dict[str, Callable[[], object]] = {
            "n": lambda: self._ask_next(1),
            "N": lambda: self._ask_next(-1),
            "Escape": lambda: explorer.ask(None),
            "r": lambda: explorer.look_from(state.cameras[0] if state.cameras else None),
            "p": lambda: explorer.screenshot(
                explorer.out / f"picture_{len(list(explorer.out.glob('*.png'))) + 1:03d}.png"
            ),
            "s": explorer.save_selection,
        }
        for number, show in enumerate(state.show_choices, 1):
            actions[str(number)] = lambda show=show: explorer.set_show(show)  # type: ignore[misc]
        for key in ("b", "v", "C"):  # pyvista's own
            self.plotter.clear_events_for_key(key)
        for key, action in actions.items():
            self.plotter.add_key_event(key, lambda action=action: self.call(action))
        self.plotter.iren.add_observer("LeftButtonPressEvent", self._on_press)
        self.plotter.iren.add_observer("LeftButtonReleaseEvent", self._on_release)
        self.refresh("")

    def call(self, action: Callable[[], object]) -> None:
        """Run an action; show its error, or what it wrote."""
        try:
            result = action()
            paths = result if isinstance(result, list) else []
            self.refresh(f"saved {paths[0].parent}" if paths else "")
        except Exception as error:  # VTK would swallow it; the window stays open
            self.refresh(error_line(error))
        self.plotter.render()

    def refresh(self, note: str) -> None:
        """Bring sliders and text up to date."""
        state = self.explorer.state
        shows = "  ".join(f"{i} {show}" for i, show in enumerate(state.show_choices, 1))
        lines = [textwrap.fill(line, 60, subsequent_indent="    ") for line in (*self.explorer.lines(), note)]
        self.text.input = "\n".join([*filter(None, lines), KEYS.format(shows=shows)])
        numbers = {"gamma": (state.gamma, state.gamma_range), "lambda": (state.distance, state.distance_range)}
        for name, widget in self.sliders.items():
            value, ends = numbers[name]
            widget.SetProcessEvents(value is not None)  # gamma needs a question
            shown = widget.GetRepresentation()
            shown.SetVisibility(value is not None)
            if value is not None:
                low, high, place = (log10(x) if name == "lambda" else x for x in (*ends, value))
                shown.SetMinimumValue(low)
                shown.SetMaximumValue(high)
                shown.SetValue(place)
                shown.SetTitleText(f"{name} {value:.3g}")

    def _slider(self, height: float, action: Callable[[float], object]) -> Any:
        widget = self.plotter.add_slider_widget(
            None, (0.0, 1.0), pointa=(0.45, height), pointb=(0.9, height), color=letters(self.plotter), style="modern",
            title_height=0.02, slider_width=0.02, tube_width=0.004,
        )  # fmt: skip
        slider = widget.GetRepresentation()
        slider.ShowSliderLabelOff()  # the title has the value
        widget.AddObserver("InteractionEvent", lambda *_: self.call(lambda: action(slider.GetValue())))
        return widget

    def _ask_next(self, step: int) -> None:
        """Ask for the next or the previous class of this scene."""
        state = self.explorer.state
        names = [state.meaning.names[label] for label in np.unique(state.labels("semantic")) if label >= 0]
        words = None if state.asked is None else state.asked.words
        place = names.index(words) if words in names else min(-step, 0)
        self.explorer.ask(names[(place + step) % len(names)] if names else None)

    def _on_press(self, *_: Any) -> None:
        self.pressed = self.plotter.iren.get_event_position()

    def _on_release(self, *_: Any) -> None:
        pressed, self.pressed = self.pressed, None
        x, y = self.plotter.iren.get_event_position()
        if pressed is not None and max(abs(x - pressed[0]), abs(y - pressed[1])) <= 3:  # pixels; further is a drag
            below = self.plotter.render_window.GetSize()[1] - 1 - y  # VTK counts rows from below
            self.call(lambda: self.explorer.pick(x, below))
