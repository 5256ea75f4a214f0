"""The viewer as a page that this machine serves: the scene is sent once, and calls are answered by a `Session`."""

from __future__ import annotations

import contextlib
import sys
import webbrowser
from collections.abc import Callable
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

from ..headless import has_display
from .html import PYTHON_START, document, pack_view
from .page_server import PageServer, Served, pack_message
from .session import Session
from .state import Exploration

if TYPE_CHECKING:
    from ...scenes import Scene


def open_page(
    exploration: Exploration,
    *,
    title: str = "kfgs",
    scene: Scene | None = None,
    out: str | Path = "kfgs_view",
    host: str = "127.0.0.1",
    port: int = 0,
) -> PageServer:
    """Serve the viewer of an exploration from a thread; `url` of the result is its link, `close()` ends it.

    Args:
        exploration: the page opens with its question, gamma, lambda and hidden classes.
        title: title of the page.
        scene: as in `save_html`.
        out: folder for files that are saved from the page.
        host: as in `PageServer`.
        port: as in `PageServer`.

    Raises:
        ValueError: if the address is not one of this machine, or the port is taken.
    """
    packed = pack_view(exploration, title=title, scene=scene)
    files = {
        "": Served("text/html; charset=utf-8", document(title, PYTHON_START).encode()),
        "pack": Served("application/octet-stream", pack_message(packed.header, packed.data)),
    }
    return PageServer(files, Session(exploration, out).call, host, port)


def serve_page(page: PageServer, *, out: str | Path, report: Callable[[str], object] | None = None) -> None:
    """Say where a page is, open it in the browser if there is a display, and wait for Ctrl-C.

    Args:
        page: from `open_page`; closed at the end.
        out: where it saves, for a note.
        report: called with the link and hints, line by line; None: standard error.
    """
    say = report or _to_stderr
    with page, contextlib.suppress(KeyboardInterrupt):
        say(f"the viewer is open at {page.url}")
        if not page.local:
            say(
                f"note: everyone who reaches this address and has the link can look, and save pictures and selections into "
                f"{out}; nothing on the way is encrypted"
            )
        say("Ctrl-C ends it; closing the tab does not")
        if has_display():  # without a display, Python would open a browser in the terminal
            webbrowser.open(page.url)
        Event().wait()


def _to_stderr(line: str) -> None:
    sys.stderr.write(line + "\n")
    sys.stderr.flush()
