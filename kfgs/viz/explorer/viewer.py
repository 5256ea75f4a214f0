"""`Viewer`: an exploration in the WebGL viewer, as a page, a notebook widget, or one file to share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from .carried import Array
from .html import save_html
from .options import ExploreOptions
from .serving import open_page, serve_page
from .state import Exploration, Show
from .widget import make_widget

MODES: dict[Show, str] = {"labels": "labels", "rgb": "color", "score": "score", "latents": "latents"}


class Viewer:
    """The WebGL viewer of an exploration. As the last value of a notebook's cell it is a widget.

    The browser draws, and keeps what a person changes; Python answers texts and writes files. So the viewer and `state` go
    separate ways after the start, except that `ask` in Python also asks in an open widget.

    Args:
        exploration: its lambda is the first one.
        options: height of the widget, folder for files.
        title: shown above the scene.
        pictures: of the exploration's cameras, [h, w, 3] uint8, in their order; None leaves one out.
    """

    def __init__(
        self,
        exploration: Exploration,
        options: ExploreOptions = ExploreOptions(),  # noqa: B008  frozen
        *,
        title: str = "kfgs",
        pictures: Sequence[Array | None] = (),
    ) -> None:
        self.state, self.options, self.title, self.pictures = exploration, options, title, pictures
        self._question: str | None = None
        self._widget: Any = None

    def ask(self, words: str | None) -> None:
        """Ask for a class or a phrase, now in an open widget, or at the start of what is shown later.

        Raises:
            ValueError: if there is no answer to these words.
        """
        self.state.ask(words)
        self._question = words
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
                self.state, title=self.title, out=options.out, thumbnails=self.pictures, ask=self._question,
                height=options.height,
            )  # fmt: skip
        return self._widget

    def serve(
        self,
        host: str = "127.0.0.1",
        port: int = 0,
        *,
        show: Show | None = None,
        report: Callable[[str], object] | None = None,
    ) -> None:
        """Serve the page until Ctrl-C; see `serve_page`.

        Args:
            host: address to listen on. With one that other machines can reach, everyone who has the link can look and save.
            port: 0: a free one.
            show: meaning of the colours at the start.
            report: called with the link and hints, line by line; None: standard error.

        Raises:
            ValueError: if the address is not one of this machine, or the port is taken.
        """
        page = open_page(
            self.state, title=self.title, out=self.options.out, thumbnails=self.pictures, ask=self._question,
            mode=None if show is None else MODES[show], host=host, port=port,
        )  # fmt: skip
        serve_page(page, out=self.options.out, report=report)

    def save_html(self, path: str | Path) -> Path:
        """Write one file that works offline, from a double click; see `kfgs.viz.explorer.save_html`."""
        return save_html(self.state, path, title=self.title, thumbnails=self.pictures)

    def close(self) -> None:
        """Close the widget, if there is one."""
        if self._widget is not None:
            self._widget.close()

    def _repr_mimebundle_(self, **options: Any) -> Any:
        return self.widget._repr_mimebundle_(**options)

    def __repr__(self) -> str:
        return f"<Viewer: {'; '.join(self.state.lines())}>"
