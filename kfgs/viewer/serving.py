"""Say where a page is, open it in the browser, and wait for its end."""

from __future__ import annotations

import sys
import webbrowser
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from threading import Event

from ..viz.headless import has_display
from .server import PageServer


def announce(page: PageServer, out: str | Path, report: Callable[[str], object] | None = None) -> None:
    """Say where a page is, and open it in the browser if there is a display.

    Args:
        page: the page.
        out: where it saves, for a note.
        report: called with the link and hints, line by line; None: standard error.
    """
    say = report or _to_stderr
    say(f"the viewer is open at {page.url}")
    if not page.local:
        say(
            f"note: everyone who reaches this address and has the link can look, and save pictures and selections into {out}; "
            "nothing on the way is encrypted"
        )
    say("Ctrl-C ends it; closing the tab does not")
    if has_display():  # without a display, Python would open a browser in the terminal
        webbrowser.open(page.url)


def wait() -> None:
    """Wait for Ctrl-C."""
    with suppress(KeyboardInterrupt):
        Event().wait()


def _to_stderr(line: str) -> None:
    sys.stderr.write(line + "\n")
    sys.stderr.flush()
