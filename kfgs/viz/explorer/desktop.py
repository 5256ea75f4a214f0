"""The explorer in a desktop window: a panel of controls, keys and the mouse."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from time import perf_counter
from typing import TYPE_CHECKING, Any

from ..._check import error_line
from ..headless import has_display
from .class_list import class_list
from .pane import PanelPane
from .panel import PanelView, Slider, Spot
from .query_line import QueryLine

if TYPE_CHECKING:
    from .explorer import Explorer

FIRST = 100.0  # priority of our observers: they run before those of pyvista and VTK, and can stop them
STILL = 3  # pixels that a click may move; further is a drag
BUSY = 0.15  # seconds: clouds that take longer to draw follow a dragged slider only half of the time
STYLES = ("gaussians", "points")
ACTIONS = ("save picture", "save selection", "reset view")
KEYS = ("/ ask: Tab, Enter, Esc; 1-4 colours; r view", "p picture; s selection; q close; click picks")


def open_window(explorer: Explorer) -> None:
    """Show an explorer in a window until the user closes it.

    A panel on the right holds the question (press "/" or click it; Tab completes a class, Enter asks, Escape clears),
    sliders for gamma and lambda (logarithmic), the colours, buttons to save, the classes, and error messages. A click on a
    cloud picks a Gaussian; a drag turns the clouds. The keys of VTK and pyvista are off, except q.

    Args:
        explorer: one that draws into a window. Afterwards it draws off-screen, with its question and picked Gaussian.

    Raises:
        RuntimeError: if there is no display, or the explorer draws off-screen.
    """
    if not has_display():
        raise RuntimeError(
            "explorer: expected a display to open a window on, got none (neither DISPLAY nor WAYLAND_DISPLAY is set); use "
            "serve(explorer) for the browser, or explorer.screenshot(path)"
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
    """Connects a window's events to the explorer's methods, and shows the results in the panel."""

    def __init__(self, explorer: Explorer) -> None:
        self.explorer = explorer
        self.line: QueryLine | None = None  # the text line while a question is typed
        self.note = self.error = ""
        self.scroll = 0
        self._drag: tuple[Slider, Spot] | None = None
        self._handle: float | None = None  # value of the dragged slider; the clouds may still show an older one
        self._pressed: tuple[int, int] | None = None  # where the mouse was pressed on a cloud
        self._applied = self._took = 0.0  # when the clouds last followed a slider, and how long that took
        self._calling = False
        self._classes = class_list(explorer.state)
        self.pane = PanelPane(explorer.plotter, self.view)
        interactor = explorer.plotter.iren.interactor
        self._tags = {
            event: interactor.AddObserver(event, handler, FIRST)
            for event, handler in {
                "KeyPressEvent": self._on_key,
                "CharEvent": self._on_character,
                "LeftButtonPressEvent": self._on_press,
                "MouseMoveEvent": self._on_move,
                "LeftButtonReleaseEvent": self._on_panel_release,
                "MiddleButtonPressEvent": self._on_other_button,
                "RightButtonPressEvent": self._on_other_button,
                "MouseWheelForwardEvent": self._on_wheel,
                "MouseWheelBackwardEvent": self._on_wheel,
            }.items()
        }
        # while a cloud turns, only the interactor's style gets events
        explorer.plotter.iren.add_observer("LeftButtonReleaseEvent", self._on_cloud_release)
        explorer.listen(self._on_change)
        explorer.set_legend(False)  # the panel lists the classes itself

    def leave(self) -> None:
        """Close the window; from now on the explorer draws off-screen, in the same size, without the panel."""
        plotter = self.explorer.plotter
        if plotter.render_window is None:  # the system destroyed the window
            return
        for tag in self._tags.values():
            plotter.iren.interactor.RemoveObserver(tag)
        plotter.render_window.Finalize()
        plotter.render_window.SetShowWindow(False)
        plotter.render_window.SetUseOffScreenBuffers(True)
        plotter.off_screen = True
        self.pane.remove()
        self.explorer.set_legend(True)

    def view(self) -> PanelView:
        """The current content of the panel."""
        state, line = self.explorer.state, self.line
        asked = "" if state.asked is None else state.asked.words
        return PanelView(
            question=asked if line is None else line.text,
            hint="" if line is None else line.hint,
            typing=line is not None,
            sliders=self._sliders(),
            choices=(("show", state.show_choices, state.show), ("style", STYLES, self.explorer.style)),
            actions=ACTIONS,
            classes=self._classes,
            names=state.meaning.names,
            hidden=state.hidden,
            scroll=self.scroll,
            lines=self.explorer.lines(),
            note=self.note,
            error=self.error,
            keys=KEYS,
        )

    def _sliders(self) -> list[Slider]:
        state = self.explorer.state
        gamma, distance = state.gamma, state.distance
        if self._drag is not None and self._handle is not None:
            gamma, distance = (self._handle, distance) if self._drag[0].name == "gamma" else (gamma, self._handle)
        sliders = [Slider("gamma", gamma, *state.gamma_range)]
        if len(state.sides) > 1:
            sliders.append(Slider("lambda", distance, *state.distance_range, logarithmic=True))
        return sliders

    # ---- actions

    def call(self, action: Callable[[], str | None]) -> None:
        """Run an action and show its result or its error in the panel; VTK's event loop would swallow an error.

        Renders once at the end: pyvista would render for each actor that is added or removed.
        """
        plotter = self.explorer.plotter
        self.note = self.error = ""
        self._calling = plotter.suppress_rendering = True
        try:
            self.note = action() or ""
        except Exception as error:  # the window stays open after any error
            self.error = error_line(error)
        finally:
            self._calling = plotter.suppress_rendering = False
        self.pane.refresh(clouds=True)

    def ask(self, words: str | None) -> None:
        """Ask a question; None clears it. A phrase can take seconds, so the panel says that it is being asked."""
        self.line = None
        if words:
            self.note, self.error = f"asking for {words!r} ...", ""
            self.pane.refresh()
        self.call(lambda: self.explorer.ask(words) and None)

    def act(self, kind: str, value: Any) -> None:
        """Do what a clicked spot of the panel stands for."""
        explorer = self.explorer
        if kind == "question":
            self.line = QueryLine(explorer.state.meaning.names)
            self.pane.refresh()
        elif kind == "show":
            self.call(lambda: explorer.set_show(value))
        elif kind == "style":
            self.call(lambda: explorer.set_style(value))
        elif kind == "name":
            self.ask(explorer.state.meaning.names[value])
        elif kind == "box":
            self.call(lambda: explorer.set_hidden(explorer.state.hidden ^ {value}))
        elif kind == "all":
            self.call(lambda: explorer.set_hidden(() if value else [label for label, _ in self._classes]))
        elif value == "save picture":
            self.call(self._save_picture)
        elif value == "save selection":
            self.call(self._save_selection)
        else:
            self.call(explorer.reset_view)

    def _save_picture(self) -> str:
        with self.pane.away():
            return f"saved {self.explorer.save_picture()}"

    def _save_selection(self) -> str:
        paths = self.explorer.save_selection()
        return f"saved {len(paths)} files in {paths[0].parent}"

    def _slide(self, x: float, last: bool) -> None:
        """Move the dragged handle. Quick clouds follow at once, slow ones sometimes, and all at the end (`last`)."""
        assert self._drag is not None
        slider, spot = self._drag
        left, _, right, _ = spot.box
        self._handle = value = slider.at((x - left) / (right - 1 - left))
        began = perf_counter()
        if not (last or self._took <= BUSY or began - self._applied > self._took):
            self.pane.refresh()
            return
        action = self.explorer.set_gamma if slider.name == "gamma" else self.explorer.set_distance
        if last:
            self._drag = self._handle = None
        self.call(lambda: action(value))
        self._applied = perf_counter()
        self._took = self._applied - began

    def _on_change(self) -> None:
        if not self._calling:  # `call` refreshes the panel itself; here a program changed the explorer
            self.pane.refresh()

    # ---- keys

    def _on_key(self, interactor: Any, event: str) -> None:
        key, character = str(interactor.GetKeySym() or ""), str(interactor.GetKeyCode() or "")
        if self.line is None and key == "q":
            return  # pyvista and VTK close the window
        self._stop(interactor, event)
        if self.line is None:
            self._command(key, character)
        elif interactor.GetControlKey():
            return
        else:
            verdict = self.line.press(key, character)
            if verdict == "ask":
                self.ask(self.line.text)
            else:
                self.line = self.line if verdict == "typing" else None
                self.pane.refresh()

    def _on_character(self, interactor: Any, event: str) -> None:
        """Stop VTK's own keys, for instance e for exit and w for wires, which use this event."""
        if self.line is not None or interactor.GetKeySym() != "q":
            self._stop(interactor, event)

    def _command(self, key: str, character: str) -> None:
        """Handle a key while no question is typed."""
        shows = self.explorer.state.show_choices
        if character == "/" or key in ("slash", "KP_Divide"):
            self.act("question", None)
        elif key == "Escape":
            self.ask(None)
        elif character in ("1", "2", "3", "4") and int(character) <= len(shows):
            self.act("show", shows[int(character) - 1])
        elif key in ("p", "s", "r"):
            self.act("do", ACTIONS["psr".index(key)])

    # ---- mouse

    def _where(self, interactor: Any) -> tuple[int, int]:
        """The mouse position, with y from the top."""
        x, y = interactor.GetEventPosition()
        return x, int(self.explorer.plotter.render_window.GetSize()[1]) - 1 - y

    def _on_press(self, interactor: Any, event: str) -> None:
        place = self._where(interactor)
        inside, spot, x = self.pane.find(*place)
        if self.line is not None and (spot is None or spot.kind != "question"):
            self.line = None
            self.pane.refresh()
        self._pressed = None if inside else place
        if not inside:
            return
        self._stop(interactor, event)
        if spot is None:
            return
        if spot.kind == "slider":
            self._drag = next(slider for slider in self._sliders() if slider.name == spot.value), spot
            self._slide(x, False)
        elif spot.kind != "question" or self.line is None:
            self.act(spot.kind, spot.value)

    def _on_move(self, interactor: Any, event: str) -> None:
        if self._drag is not None:
            self._stop(interactor, event)
            self._slide(self.pane.find(*self._where(interactor))[2], False)

    def _on_panel_release(self, interactor: Any, event: str) -> None:
        if self._drag is not None:
            self._stop(interactor, event)
            self._slide(self.pane.find(*self._where(interactor))[2], True)

    def _on_cloud_release(self, *_: Any) -> None:
        pressed, self._pressed = self._pressed, None
        place = self._where(self.explorer.plotter.iren.interactor)
        if pressed is not None and max(abs(a - b) for a, b in zip(pressed, place, strict=True)) <= STILL:
            self.call(lambda: None if self.explorer.pick(*place) is not None else "nothing there to pick")

    def _on_other_button(self, interactor: Any, event: str) -> None:
        if self.pane.find(*self._where(interactor))[0]:
            self._stop(interactor, event)

    def _on_wheel(self, interactor: Any, event: str) -> None:
        if self.pane.find(*self._where(interactor))[0]:
            self._stop(interactor, event)
            step = -1 if event == "MouseWheelForwardEvent" else 1
            self.scroll = min(max(self.scroll + step, 0), self.pane.panel.last_scroll)
            self.pane.refresh()

    def _stop(self, interactor: Any, event: str) -> None:
        """Keep this event from all later observers."""
        interactor.GetCommand(self._tags[event]).SetAbortFlag(True)
