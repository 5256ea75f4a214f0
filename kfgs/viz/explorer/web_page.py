"""The explorer's page: sends its content to the browser, and turns buttons, sliders and clicks into method calls."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from math import isfinite, log
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from ..._check import error_line
from ..palette import palette
from .class_list import class_list
from .web_mouse import make_mouse
from .web_picture import Pictures, make_delivery

if TYPE_CHECKING:
    from .explorer import Explorer

FILES = Path(__file__).with_name("page")
TITLES = {
    "labels": "classes",
    "rgb": "colours",
    "score": "score",
    "latents": "latents",
    "auto": "automatic",
    "gaussians": "Gaussians",
    "points": "points",
}
CLOUDS = 'class="clouds" role="application" tabindex="-1" aria-label="both clouds: drag to turn, click to pick"'
# a click is a left press and release within 3 pixels; its position is sent as shares of the clouds' width and height
PRESS = '@pointerdown.capture="$event.currentTarget.press = [$event.clientX, $event.clientY, $event.button]"'
CLICK = (
    '@pointerup.capture="$event.button === 0 && $event.currentTarget.press && $event.currentTarget.press[2] === 0'
    " && Math.hypot($event.clientX - $event.currentTarget.press[0], $event.clientY - $event.currentTarget.press[1]) <= 3"
    " && trigger('pick', [($event.clientX - $event.currentTarget.getBoundingClientRect().left)"
    " / $event.currentTarget.getBoundingClientRect().width,"
    " ($event.clientY - $event.currentTarget.getBoundingClientRect().top)"
    ' / $event.currentTarget.getBoundingClientRect().height])"'
)
STEP = 5e-4  # half a step of the sliders, which go from 0 to 1
LONGEST = 200  # characters of a question

log_ = logging.getLogger(__name__)
Action = Callable[[], object]


class ExplorerPage:
    """An explorer in a browser.

    Events of the browser wait in a queue. Of a slider only the latest position is kept, so that drawing can follow. Every
    change of the explorer, also by a notebook cell, changes the page.

    Args:
        explorer: the explorer to show.
        server: a trame server for this page alone, not yet started.
    """

    def __init__(self, explorer: Explorer, server: Any) -> None:
        self.explorer, self.server = explorer, server
        self._waiting: dict[str, tuple[Action, bool]] = {}
        self._wake = asyncio.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._asked: str | None = None
        self._acting = False
        self._saved = self._error = self._pointed = ""
        self._fill()
        self.pictures = Pictures(explorer.plotter, self._resized, explorer.lock)
        self._fitted: object = self.pictures.camera
        self.view = self._lay_out()
        server.add_protocol_to_configure(self._add_protocols)
        for name in ("ask", "set_number", "set_show", "set_style", "hide", "hide_all", "pick"):
            server.trigger(name)(getattr(self, f"_on_{name}"))
        for name in ("save_picture", "save_selection", "reset_view"):
            server.trigger(name)(getattr(self, f"_on_{name}"))
        server.state.change("gamma_at")(self._on_gamma)
        server.state.change("distance_at")(self._on_distance)
        explorer.listen(self._changed)

    def _add_protocols(self, protocol: Any) -> None:
        delivery = make_delivery(self.pictures)
        protocol.registerLinkProtocol(delivery)
        protocol.registerLinkProtocol(make_mouse(self.pictures, delivery))

    async def work(self) -> None:
        """Run the browser's actions until cancelled or the explorer is closed."""
        self._loop = asyncio.get_running_loop()
        self._wake.set()  # a notebook cell may have changed the explorer before
        while True:
            await self._wake.wait()
            self._wake.clear()
            if self.pictures.gone:
                return
            if self._waiting:
                await self._tell_working(True)
                self._error = ""
            while self._waiting:
                self._do(*self._waiting.pop(next(iter(self._waiting))))
            self._show()
            await self._tell_working(False)

    def _do(self, action: Action, draws: bool = False) -> None:
        """Run an action. `_show` renders afterwards; an action that `draws` needs pictures before: to save or time them."""
        plotter = self.explorer.plotter
        with self.explorer.lock:
            self._acting, plotter.suppress_rendering = True, not draws
            try:
                action()
            except ValueError as error:
                self._error = str(error)
            except Exception as error:  # show it: the page must go on
                log_.exception("the explorer's page could not do what was asked")
                self._error = error_line(error)
            finally:
                self._acting, plotter.suppress_rendering = False, False

    async def _tell_working(self, working: bool) -> None:
        with self.server.state as state:
            state.working = working
        await asyncio.sleep(0)  # lets trame send it

    def _queue(self, key: str, action: Action, draws: bool = False) -> None:
        self._waiting.pop(key, None)
        self._waiting[key] = action, draws
        self._wake.set()

    def _changed(self) -> None:
        """Called after each change of the explorer, for instance by a notebook cell or another page."""
        if not self._acting and self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._wake.set)

    # Events from the browser. They may hold anything: the explorer checks values, and none of them is used as a path.

    def _on_ask(self, words: object) -> None:
        said = str(words)
        if said not in self.explorer.state.meaning.names:  # a class may have a longer name
            said = said[:LONGEST].strip()
        self._queue("ask", lambda: self.explorer.ask(said or None))

    def _on_set_number(self, name: object, text: object) -> None:
        action = {"gamma": self.explorer.set_gamma, "distance": self.explorer.set_distance}[str(name)]
        self._queue(str(name), lambda: action(_number(str(name), text)))

    def _on_set_show(self, value: object) -> None:
        self._queue("show", lambda: self.explorer.set_show(value))  # type: ignore[arg-type]

    def _on_set_style(self, value: object) -> None:
        self._queue("style", lambda: self.explorer.set_style(value), draws=True)  # type: ignore[arg-type]

    def _on_hide(self, label: object, hidden: object) -> None:
        def action() -> None:
            one = {_label(label)}
            others = self.explorer.state.hidden - one
            self.explorer.set_hidden(sorted(others | one if hidden else others))

        self._queue(f"hide {label!r}", action)

    def _on_hide_all(self, hidden: object) -> None:
        labels = [label for label, _ in class_list(self.explorer.state)] if hidden else []
        self._queue("hide", lambda: self.explorer.set_hidden(labels))

    def _on_pick(self, across: object, down: object) -> None:
        def action() -> None:
            width, height = self.explorer.plotter.render_window.GetSize()
            found = self.explorer.pick(_share(across) * width, _share(down) * height)
            self._pointed = "" if found is not None else "Nothing is drawn there."

        self._queue("pick", action)

    def _on_save_picture(self) -> None:
        self._queue("picture", lambda: self._set_saved([self.explorer.save_picture()]), draws=True)

    def _on_save_selection(self) -> None:
        self._queue("selection", lambda: self._set_saved(self.explorer.save_selection()))

    def _on_reset_view(self) -> None:
        self._queue("view", self._fit)

    def _resized(self) -> None:
        """The panes changed shape: if the user has not turned the view, show the whole scene again."""
        if self.pictures.camera == self._fitted and not self._acting:
            self._do(self._fit)

    def _fit(self) -> None:
        """Go to the first view, and move back if panes are narrow, because VTK fits the height."""
        self.explorer.reset_view()
        renderers = self.explorer.plotter.renderers
        width, height = renderers[0].GetSize()
        if width < height:
            renderers[0].GetActiveCamera().Dolly(width / height)
            for renderer in renderers:
                renderer.ResetCameraClippingRange()
        self._fitted = self.pictures.camera

    def _on_gamma(self, gamma_at: object, **_: object) -> None:
        low, high = self.explorer.state.gamma_range
        if self.explorer.state.gamma is not None and _differs(gamma_at, self._gamma_at()):
            self._queue("gamma", lambda: self.explorer.set_gamma(low + _share(gamma_at) * (high - low)))

    def _on_distance(self, distance_at: object, **_: object) -> None:
        low, high = self.explorer.state.distance_range
        if _differs(distance_at, self._distance_at()):
            self._queue("distance", lambda: self.explorer.set_distance(low * (high / low) ** _share(distance_at)))

    # The content of the page.

    def _fill(self) -> None:
        """Set the page's constants and first values."""
        from .options import Style

        state = self.explorer.state
        self.server.state.update({
            "trame__title": "kfgs explorer",
            "query": "",
            "names": list(dict.fromkeys(state.meaning.names)),
            "hint": state.meaning.names[0] if state.meaning.names else "",
            "has_color": "color" in state.sides,
            "shows": [{"value": value, "title": TITLES.get(value, value)} for value in state.show_choices],
            "styles": [{"value": value, "title": TITLES.get(value, value)} for value in get_args(Style)],
            "working": False,
            "gamma_at": 0.0,
            "distance_at": self._distance_at(),
        })  # fmt: skip
        self._write()

    def _write(self) -> None:
        state, page = self.explorer.state, self.server.state
        asked = None if state.asked is None else state.asked.words
        if asked != self._asked:
            self._asked, page.query = asked, asked or ""
        page.update({
            "asked": asked or "",
            "error": self._error,
            "gamma": "" if state.gamma is None else float(f"{state.gamma:.4g}"),
            "distance": float(f"{state.distance:.4g}"),
            "show": state.show,
            "style": self.explorer.style,
            "lines": state.lines(),
            "picked": [] if state.picked is None else state.picked.lines(),
            "classes": self._classes(),
            "pointed": self._pointed,
            "saved": self._saved,
        })  # fmt: skip
        for name, here in (("gamma_at", self._gamma_at()), ("distance_at", self._distance_at())):
            if _differs(page[name], here):  # a slider that is close enough stays where the user holds it
                page[name] = here

    def _classes(self) -> list[dict[str, Any]]:
        state = self.explorer.state
        rows, labels = class_list(state), state.labels("semantic")
        colors = palette(np.array([label for label, _ in rows], dtype=np.int64), state.meaning.names)
        counts = [int((labels == label).sum()) for label, _ in rows]
        return [
            {
                "label": label,
                "name": name,
                "count": f"{count:,}" if count else "",
                "color": "#{:02x}{:02x}{:02x}".format(*color),
                "shown": label not in state.hidden,
            }
            for (label, name), count, color in zip(rows, counts, colors.tolist(), strict=True)
        ]

    def _show(self) -> None:
        """Send the new numbers, then the new picture."""
        with self.server.state:
            self._write()
        self.pictures.changes += 1
        self.view.update()

    def _set_saved(self, paths: list[Path]) -> None:
        self._saved = "saved " + ", ".join(str(path) for path in paths)

    def _gamma_at(self) -> float:
        low, high = self.explorer.state.gamma_range
        gamma = self.explorer.state.gamma
        return 0.0 if gamma is None or high <= low else min(max((gamma - low) / (high - low), 0.0), 1.0)

    def _distance_at(self) -> float:
        low, high = self.explorer.state.distance_range
        return min(max(log(self.explorer.state.distance / low) / log(high / low), 0.0), 1.0)

    def _lay_out(self) -> Any:
        """Build the page from `page/page.html` and the view of the clouds. A scene's names are data, never template."""
        from trame.ui.html import DivLayout
        from trame.widgets import html
        from trame_vtk.widgets.vtk import VtkRemoteView

        self.server.enable_module({"serve": {"kfgs_page": str(FILES)}, "styles": ["kfgs_page/page.css"]})
        with DivLayout(self.server, classes="kfgs") as layout:
            layout.root.add_child((FILES / "page.html").read_text(encoding="utf-8"))
            with html.Div(raw_attrs=[CLOUDS, PRESS, CLICK]):
                view = VtkRemoteView(
                    self.explorer.plotter.render_window, interactive_quality=80, interactive_ratio=1, still_quality=95
                )
        return view


def _label(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"label: expected a whole number, got {str(value)[:40]!r}; reload the page")
    return value


def _differs(at: object, here: float) -> bool:
    return not isinstance(at, (int, float)) or not abs(at - here) <= STEP


def _share(value: object) -> float:
    """A position between 0 and 1 from the browser."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not isfinite(value):
        raise ValueError(f"position: expected a number between 0 and 1, got {str(value)[:40]!r}; reload the page")
    return min(max(float(value), 0.0), 1.0)


def _number(name: str, text: object) -> float:
    try:
        return float(str(text)[:40].replace(",", "."))
    except ValueError:
        raise ValueError(f"{name}: expected a number, got {str(text)[:40]!r}; write it as 0.05") from None
