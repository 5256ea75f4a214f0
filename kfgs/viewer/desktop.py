"""The explorer in a desktop window: pyvista's sliders, text and keys; a click picks."""

from __future__ import annotations

import textwrap
import warnings
from collections.abc import Callable
from math import log10
from typing import TYPE_CHECKING, Any

from .._card import error_line
from ..viz.headless import has_display
from ..viz.legends import letters

if TYPE_CHECKING:
    from .explorer import Explorer

STILL = 3  # pixels that the mouse may move during a click; further is a drag
COLUMNS = 60  # characters in a line of text
HELP = """k  hide these keys
n, N  next, previous class    Esc  no class
h  hide this class    H  show all classes
{shows}
g  Gaussians or points    r  first view
click  pick    drag  turn    up, down  zoom
p  save the picture    s  save the selection    q  close"""


def open_window(explorer: Explorer) -> None:
    """Show an explorer in a pyvista window until the user closes it.

    Sliders change gamma and lambda (logarithmic), a click picks a Gaussian, a drag turns the clouds, and keys do the rest;
    press k to see them. To search for a phrase, call `explorer.ask` first: pyvista has no text field.

    Args:
        explorer: one that draws into a window. Afterwards it draws off-screen, with its question and picked Gaussian.

    Raises:
        RuntimeError: if there is no display, or the explorer draws off-screen.
    """
    if not has_display():
        raise RuntimeError(
            "explorer: expected a display to open a window on, got none (neither DISPLAY nor WAYLAND_DISPLAY is set); use "
            "where='browser', or explorer.screenshot(path)"
        )
    if explorer.plotter.off_screen:
        raise RuntimeError(
            "explorer: expected one that draws into a window, got one that draws off-screen; make it with off_screen=False"
        )
    desktop = Desktop(explorer)
    with warnings.catch_warnings():  # pyvista closes the plotter if the system destroys the window
        warnings.filterwarnings("ignore", ".*auto_close. ignored", UserWarning)
        explorer.plotter.show(title="kfgs", auto_close=False)
    desktop.leave()


class Desktop:
    """Adds sliders, a text and keys to an explorer's plotter; they call the explorer's methods."""

    def __init__(self, explorer: Explorer) -> None:
        self.explorer, self.plotter = explorer, explorer.plotter
        self.note = ""  # the result or the error of the last action
        self._help_shown = False
        self._pressed: tuple[int, int] | None = None  # where the mouse was pressed on a cloud
        last = len(explorer.state.sides) - 1
        self.plotter.subplot(0, last)
        place = 0.012 if last else 0.25, 0.93  # below the title, beside the legend
        ink = letters(self.plotter)
        self.text: Any = self.plotter.add_text("", position=place, viewport=True, font_size=7, color=ink)
        self.text.prop.justification_vertical = "top"
        self.text.prop.background_color, self.text.prop.background_opacity = self.plotter.background_color, 0.8
        self.plotter.subplot(0, 0)  # in another subplot, VTK looks for the mouse in the wrong place
        self.sliders = {"gamma": self._slider(0.13, lambda x: explorer.set_gamma(x))}
        if last:
            self.sliders["lambda"] = self._slider(0.06, lambda x: explorer.set_distance(10**x))
        self._bind_keys()
        self.plotter.iren.add_observer("LeftButtonPressEvent", self._on_press)
        self.plotter.iren.add_observer("LeftButtonReleaseEvent", self._on_release)
        explorer.listen(self.refresh)
        self.refresh()

    def leave(self) -> None:
        """Close the window; from now on the explorer draws off-screen, without sliders and text."""
        window = self.plotter.render_window
        if window is None:  # the system destroyed it
            return
        window.Finalize()
        window.SetShowWindow(False)
        window.SetUseOffScreenBuffers(True)
        self.plotter.off_screen = True
        self.plotter.clear_slider_widgets()
        self.plotter.remove_actor(self.text, render=False)

    def refresh(self) -> None:
        """Bring sliders and text up to date, without rendering."""
        state = self.explorer.state
        lines = [textwrap.fill(line, COLUMNS, subsequent_indent="    ") for line in (*self.explorer.lines(), self.note)]
        shows = "    ".join(f"{i}  {show}" for i, show in enumerate(state.show_choices, 1))
        keys = HELP.format(shows=shows) if self._help_shown else "k  show the keys"
        self.text.input = "\n".join([*filter(None, lines), keys])
        self.text.SetVisibility(True)
        numbers = {"gamma": (state.gamma, state.gamma_range), "lambda": (state.distance, state.distance_range)}
        for name, widget in self.sliders.items():
            value, ends = numbers[name]
            widget.SetProcessEvents(value is not None)  # gamma needs a question
            widget.GetRepresentation().SetVisibility(value is not None)
            if value is not None:
                low, high, place = (log10(x) if name == "lambda" else x for x in (*ends, value))
                widget.GetRepresentation().SetMinimumValue(low)
                widget.GetRepresentation().SetMaximumValue(high)
                widget.GetRepresentation().SetValue(place)
                widget.GetRepresentation().SetTitleText(f"{name} {value:.3g}")

    def call(self, action: Callable[[], object], render: bool = True) -> None:
        """Run an action, show its error or the text that it returns, and render once."""
        self.note, self.plotter.suppress_rendering = "", True
        try:
            result = action()
            self.note = result if isinstance(result, str) else ""
        except Exception as error:  # VTK would swallow it; the window stays open
            self.note = error_line(error)
        finally:
            self.plotter.suppress_rendering = False
        self.refresh()
        if render:
            self.plotter.render()

    def _slider(self, height: float, action: Callable[[float], None]) -> Any:
        widget = self.plotter.add_slider_widget(
            None, (0.0, 1.0), pointa=(0.45, height), pointb=(0.9, height), color=letters(self.plotter), style="modern",
            title_height=0.02, slider_width=0.02, tube_width=0.004,
        )  # fmt: skip
        slider = widget.GetRepresentation()
        slider.ShowSliderLabelOff()  # the title has the value
        slider.GetTitleProperty().BoldOff()
        slider.GetTitleProperty().ShadowOff()
        moved = lambda *_: self.call(lambda: action(slider.GetValue()), render=False)  # noqa: E731  the widget renders
        widget.AddObserver("InteractionEvent", moved)
        return widget

    def _bind_keys(self) -> None:
        explorer, state = self.explorer, self.explorer.state
        for key in ("b", "v", "C"):  # pyvista's own
            self.plotter.clear_events_for_key(key)
        actions: dict[str, Callable[[], object]] = {
            "n": lambda: self._ask_next(1),
            "N": lambda: self._ask_next(-1),
            "Escape": lambda: explorer.ask(None),
            "h": lambda: explorer.set_hidden([*state.hidden, *([state.asked.words] if state.asked else [])]),
            "H": lambda: explorer.set_hidden([]),
            "g": lambda: explorer.set_style("gaussians" if explorer.style == "points" else "points"),
            "r": explorer.reset_view,
            "p": self._save_picture,
            "s": lambda: f"saved {explorer.save_selection()[0].parent}",
            "k": self._switch_help,
        }
        for number, show in enumerate(state.show_choices, 1):
            actions[str(number)] = lambda show=show: explorer.set_show(show)  # type: ignore[misc]
        for key, action in actions.items():
            self.plotter.add_key_event(key, lambda action=action: self.call(action))
        interactor = self.plotter.iren.interactor
        stop = lambda *_: interactor.GetCommand(tag).SetAbortFlag(interactor.GetKeySym() != "q")  # noqa: E731
        tag: int = interactor.AddObserver("CharEvent", stop, 1.0)  # VTK's own keys, for instance w for wires

    def _ask_next(self, step: int) -> None:
        """Ask for the next or the previous class of this scene."""
        state = self.explorer.state
        names = list(dict.fromkeys(state.meaning.names[label] for label in sorted(state.present) if label >= 0))
        words = None if state.asked is None else state.asked.words
        place = names.index(words) if words in names else min(-step, 0)
        self.explorer.ask(names[(place + step) % len(names)] if names else None)

    def _save_picture(self) -> str:
        for control in (self.text, *(widget.GetRepresentation() for widget in self.sliders.values())):
            control.SetVisibility(False)  # `refresh` shows them again
        self.plotter.render_window.Render()  # pyvista takes its pictures from the last frame
        return f"saved {self.explorer.save_picture()}"

    def _switch_help(self) -> None:
        self._help_shown = not self._help_shown

    def _on_press(self, *_: Any) -> None:
        self._pressed = self.plotter.iren.get_event_position()

    def _on_release(self, *_: Any) -> None:
        pressed, self._pressed = self._pressed, None
        x, y = self.plotter.iren.get_event_position()
        if pressed is not None and max(abs(x - pressed[0]), abs(y - pressed[1])) <= STILL:
            below = self.plotter.render_window.GetSize()[1] - 1 - y  # VTK counts rows from below
            self.call(lambda: "nothing there to pick" if self.explorer.pick(x, below) is None else None)
