"""Both clouds side by side in pyvista: as a picture, or in a desktop window with sliders."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .._check import as_array
from .._files import as_path
from ..cameras import Camera
from ..cameras.camera import NEAR
from ..viz.clouds import add_cloud, recolor_cloud
from ..viz.colors import COLORMAP, Array
from ..viz.legends import add_legend, add_title, letters
from ..viz.linked import look_over
from ..viz.pictures import save_picture
from ..viz.plotter import has_display, look_through, make_plotter
from .meaning import Asked
from .session import labelled, save_selection
from .state import Exploration, Show, Side

SIDE_NAMES: dict[Side, str] = {"semantic": "semantic field", "color": "colour field"}
SHOW_NAMES: dict[Show, str] = {"labels": "classes", "rgb": "colours", "score": "scores", "latents": "latents"}
MANY = 150_000  # Gaussians: a frame of them takes half a second in software; more are drawn as points
REST = 0.04  # factor on the opacity of Gaussians that are not selected; points fade to almost white instead
HIGHLIGHT = np.array((255, 120, 0))  # tints a selection shown in its own colours: a white sofa is hard to see on white


class Explorer(AbstractContextManager["Explorer"]):
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

    def look_from(self, camera: Camera | None) -> None:
        """Look through a posed camera: its whole picture, at its aspect ratio; None: at everything but floaters."""
        self.plotter.subplot(0, 0)
        if camera is None:
            look_over(self.plotter, self.state.up)
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

    def show(self) -> None:
        """Open a window until the user closes it: a drag turns both clouds, and sliders change gamma and lambda.

        To search, call `ask` first. A RuntimeError if there is no display.
        """
        if not has_display() or self.plotter.off_screen:
            self.close()
            raise RuntimeError("where: expected a display for a window, got none; use 'browser' or 'picture'")
        state, place = self.state, {"pointa": (0.45, 0.13), "pointb": (0.9, 0.13)}
        if state.gamma is not None:
            self.plotter.add_slider_widget(self.set_gamma, state.gamma_range, value=state.gamma, title="gamma", **place)
        if "color" in state.sides:
            self.plotter.subplot(0, 1)
            self.plotter.add_slider_widget(
                self.set_distance, state.distance_range, value=state.distance, title="lambda", **place
            )
        self.plotter.show(title="kfgs")

    def close(self) -> None:
        """Close the window; a second call does nothing."""
        self.plotter.close()

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
                    colors = np.where(rest[:, None], 215 + colors // 8, colors)  # the state keeps its own
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
        plotter.subplot(0, 0)
        plotter.suppress_rendering = False
        if not plotter.off_screen:
            plotter.render()  # does nothing before the window is shown
