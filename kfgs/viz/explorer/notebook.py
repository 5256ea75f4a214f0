"""The explorer inside a notebook: a picture that stays, and over it the page while the kernel runs."""

from __future__ import annotations

import asyncio
import base64
import html
import io
import json
import logging
import secrets
import socket
import sys
import weakref
from typing import TYPE_CHECKING, Any

from PIL import Image

from .web import Listening, require_web

if TYPE_CHECKING:
    from .explorer import Explorer

LEAST = 560  # pixels of the page's height, for its controls
QUALITY = 80  # of the JPEG that a saved notebook keeps: some 60 kB
# The page is asked for again until the kernel, which may be busy, answers; a picture that only the page's server has is
# what tells that it does. A kernel on another machine never answers, and the picture stays.
SCRIPT = """(() => {
  const box = document.getElementById(ID), url = URL_, probe = () => {
    const image = new Image();
    image.onload = () => {
      const frame = document.createElement('iframe');
      frame.src = url;
      frame.title = 'explorer';
      frame.style.cssText = 'width:100%;height:' + HEIGHT + 'px;border:1px solid #ddd';
      box.replaceChildren(frame);
    };
    image.onerror = () => { if (tries-- > 0 && document.body.contains(box)) setTimeout(probe, 500); };
    image.src = url.replace('index.html', 'logo.png?' + tries);
  };
  let tries = 120;
  if (box) probe();
})();"""

_open: weakref.WeakKeyDictionary[Any, tuple[Listening, asyncio.Task[None]]] = weakref.WeakKeyDictionary()


def in_notebook() -> bool:
    """Whether a Jupyter kernel runs this program."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return getattr(shell, "kernel", None) is not None


def show_in_notebook(explorer: Explorer) -> None:
    """Show an explorer in the output of the cell: its page where the kernel runs on this machine, else a picture.

    The page is served by the kernel itself, to this machine only; it shows what cells do to the explorer, and cells see
    what was done in it. The saved notebook keeps the picture. Without the extra `web`, or without a kernel, there is the
    picture alone, and a line that says how to get the controls.

    Args:
        explorer: what to look at, with a plotter that is off the screen.
    """
    reason = _reason()
    picture = _picture(explorer)
    if reason is not None:
        _display(f"{picture}<p><small>{html.escape(reason)}</small></p>", reason)
        return
    if explorer not in _open or _open[explorer][1].done():
        listening = Listening(explorer, "127.0.0.1", _free_port())
        task = asyncio.get_running_loop().create_task(_serve(listening))
        task.add_done_callback(_tell)
        _open[explorer] = listening, task
    url, height = _open[explorer][0].url, max(explorer.plotter.render_window.GetSize()[1], LEAST)
    name = f"kfgs-{secrets.token_hex(8)}"  # of the output: a cell may be run twice
    script = SCRIPT.replace("ID", json.dumps(name)).replace("URL_", json.dumps(url)).replace("HEIGHT", str(height))
    _display(f'<div id="{name}">{picture}</div><script>{script}</script>', f"the explorer is open at {url}")


def _reason() -> str | None:
    """Why there are no controls here; None where there are."""
    if not in_notebook():
        return "controls need a Jupyter kernel: open this in a notebook, or look with where='browser'"
    try:
        require_web()
    except ImportError:
        return 'controls need the extra "web": pip install "kfgs[web]"'
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return "controls need a kernel with an event loop (ipykernel); look with where='browser'"
    return None


async def _serve(listening: Listening) -> None:
    async with listening:
        await listening.ended()


def _tell(task: asyncio.Task[None]) -> None:
    if not task.cancelled() and task.exception() is not None:
        logging.getLogger(__name__).error("the explorer's page ended: %s", task.exception())


def _free_port() -> int:
    """The link is shown before the server starts, in the same cell."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def _picture(explorer: Explorer) -> str:
    file = io.BytesIO()
    Image.fromarray(explorer.screenshot()).save(file, "JPEG", quality=QUALITY, optimize=True)
    data = base64.b64encode(file.getvalue()).decode("ascii")
    return f'<img alt="the explorer, as it was" style="max-width:100%" src="data:image/jpeg;base64,{data}">'


class _Output:
    """Both for a notebook and for what shows only words."""

    def __init__(self, page: str, words: str) -> None:
        self.page, self.words = page, words

    def __repr__(self) -> str:
        return self.words

    def _repr_html_(self) -> str:
        return self.page


def _display(page: str, words: str) -> None:
    try:
        from IPython.display import display
    except ImportError:
        raise ImportError(
            "where: expected IPython for a notebook, got none; use where='browser' or where='picture'"
        ) from None
    display(_Output(page, words))
