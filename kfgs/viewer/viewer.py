"""`Viewer`: an exploration in the WebGL viewer, as a page, a notebook widget, or one file to share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .document import PYTHON_START, document
from .html import save_html, scene_for_page
from .options import ExploreOptions
from .server import PageServer
from .serving import announce, wait
from .session import Session
from .state import Exploration
from .widget import make_widget

if TYPE_CHECKING:
    from ..scenes import Scene


class Viewer:
    """The WebGL viewer of an exploration. As the last value of a notebook's cell it is a widget.

    The browser draws, and keeps what a person changes; Python answers texts and writes files. It opens with the state's question,
    gamma, lambda, colours and hidden classes. After that, page and state are independent, except that `ask` in Python also
    asks in an open widget.

    Args:
        exploration: the state.
        options: height of the widget, folder for files.
        title: shown above the scene.
        scene: has the photos of the exploration's cameras, found by name; None: without photos.
    """

    def __init__(
        self,
        exploration: Exploration,
        options: ExploreOptions = ExploreOptions(),  # noqa: B008  frozen
        *,
        title: str = "kfgs",
        scene: Scene | None = None,
    ) -> None:
        self.state, self.options, self.title, self.scene = exploration, options, title, scene
        self._widget: Any = None

    def ask(self, words: str | None) -> None:
        """Ask for a class or a phrase, now in an open widget, or at the start of what is shown later.

        Raises:
            ValueError: if there is no answer to these words.
        """
        self.state.ask(words)
        if self._widget is not None:
            self._widget.question = words or ""

    @property
    def widget(self) -> Any:
        """The notebook widget (anywidget), made when it is first wanted.

        Raises:
            ImportError: if anywidget is missing.
        """
        if self._widget is None:
            options = self.options
            self._widget = make_widget(
                self.state, title=self.title, scene=self.scene, out=options.out, height=options.height
            )
        return self._widget

    def serve(self, host: str = "127.0.0.1", port: int = 0, *, report: Callable[[str], object] | None = None) -> None:
        """Open the page in the browser, and serve it until Ctrl-C.

        Args:
            host: address to listen on. With one that other machines can reach, everyone who has the link can look and save.
            port: 0: a free one.
            report: called with the link and hints, line by line; None: standard error.

        Raises:
            ValueError: if the address is not one of this machine, or the port is taken.
        """
        with self.open_page(host, port) as page:
            announce(page, self.options.out, report)
            wait()

    def open_page(self, host: str = "127.0.0.1", port: int = 0) -> PageServer:
        """Serve the page from a thread: `url` of the result is its link, `close()` ends it. Otherwise as `serve`."""
        page = PageServer(document(self.title, PYTHON_START), host, port)
        self.show_in(page)
        return page

    def show_in(self, page: PageServer) -> bytes:
        """Give a page its scene, packed; returns it."""
        packed = scene_for_page(self.state, title=self.title, scene=self.scene)
        page.show(packed, Session(self.state, self.options.out).call)
        return packed

    def save_html(self, path: str | Path) -> Path:
        """Write one file that works offline, from a double click; see `kfgs.viewer.save_html`."""
        return save_html(self.state, path, title=self.title, scene=self.scene)

    def close(self) -> None:
        """Close the widget, if there is one."""
        if self._widget is not None:
            self._widget.close()

    def _repr_mimebundle_(self, **options: Any) -> Any:
        return self.widget._repr_mimebundle_(**options)

    def __repr__(self) -> str:
        return f"<Viewer: {'; '.join(self.state.lines())}>"
