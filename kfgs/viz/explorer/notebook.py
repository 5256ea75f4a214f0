"""The explorer in a notebook: a picture that stays, replaced by the page while the kernel runs."""

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
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from PIL import Image

from .web import Listening, loop_runs, require_open, require_web

if TYPE_CHECKING:
    from .explorer import Explorer

LEAST = 640  # height of the page in pixels: its controls need so much
QUALITY = 80  # of the JPEG kept in a saved notebook: about 60 kB
# The script loads a small picture from the page's server again and again, until the kernel, which may be busy, answers.
# Then it shows the page. A kernel on another machine never answers, and the picture stays.
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


class Run(NamedTuple):
    """One run of a notebook cell."""

    cell: str
    number: int


_open: dict[Explorer, tuple[Listening, asyncio.Task[None]]] = {}  # explorers whose page is being served
_shown: weakref.WeakKeyDictionary[Explorer, Run] = weakref.WeakKeyDictionary()
_made: weakref.WeakKeyDictionary[Explorer, Run] = weakref.WeakKeyDictionary()


def in_notebook() -> bool:
    """Whether a Jupyter kernel runs this program."""
    return getattr(_shell(), "kernel", None) is not None


def show_in_notebook(explorer: Explorer) -> None:
    """Show an explorer in the cell's output: its page if the kernel runs on this machine, else a picture.

    The kernel serves the page, to this machine only. Cells and page change the same explorer. The saved notebook keeps the
    picture. Without the extra `web`, or without a kernel, there is only the picture, with a line on how to get the
    controls. `explorer.close()` ends the page. If a later cell displays the explorer, the page moves there.

    Args:
        explorer: one that draws off-screen.

    Raises:
        RuntimeError: if the explorer is closed.
    """
    require_open(explorer)
    run, reason = _this_run(), _reason()
    if run is not None:
        _shown[explorer] = run
        _shell().display_formatter.ipython_display_formatter.for_type(type(explorer), _display_again)
    picture = _picture(explorer)
    if reason is not None:
        _display(f"{picture}<p><small>{html.escape(reason)}</small></p>", reason)
        return
    if explorer not in _open:
        listening = Listening(explorer, "127.0.0.1", _free_port())
        task = asyncio.get_running_loop().create_task(_serve(listening))
        _open[explorer] = listening, task
        task.add_done_callback(partial(_ended, explorer))
    url, height = _open[explorer][0].url, max(explorer.plotter.render_window.GetSize()[1], LEAST)
    name = f"kfgs-{secrets.token_hex(8)}"  # id of this output, because a cell can run twice
    script = SCRIPT.replace("ID", json.dumps(name)).replace("URL_", json.dumps(url)).replace("HEIGHT", str(height))
    _display(f'<div id="{name}">{picture}</div><script>{script}</script>', f"the explorer is open at {url}")


def close_earlier(explorer: Explorer) -> None:
    """Close the explorer that an earlier run of this cell made.

    The front end usually tells which cell runs; if not, cells with the same text count as the same.
    """
    run = _this_run()
    if run is None:
        return
    for other, its in list(_made.items()):
        if its.cell == run.cell and its.number != run.number:
            other.close()
            del _made[other]
    _made[explorer] = run


def _display_again(explorer: Explorer) -> None:
    """Display an explorer as a cell's last value: its page, unless this cell already shows it."""
    run = _this_run()
    if explorer.closed or explorer not in _shown or run is None:
        raise NotImplementedError  # makes IPython show the picture
    if _shown[explorer] != run:
        show_in_notebook(explorer)


def _shell() -> Any:
    ipython = sys.modules.get("IPython")
    return None if ipython is None else ipython.get_ipython()


def _this_run() -> Run | None:
    """The cell that runs now; None without a kernel."""
    if not in_notebook():
        return None
    shell = _shell()
    get_parent = getattr(shell.kernel, "get_parent", None)  # ipykernel's
    told = None if get_parent is None else get_parent("shell").get("metadata", {}).get("cellId")
    return Run(told or shell.history_manager.input_hist_raw[-1], shell.execution_count)


def _reason() -> str | None:
    """Why there are no controls here; None if there are."""
    if not in_notebook():
        return "controls need a Jupyter kernel: open this in a notebook, or look with where='browser'"
    try:
        require_web()
    except ImportError:
        return 'controls need the extra "web": pip install "kfgs[web]"'
    if not loop_runs():
        return "controls need a kernel with an event loop (ipykernel); look with where='browser'"
    return None


async def _serve(listening: Listening) -> None:
    async with listening:
        await listening.ended()


def _ended(explorer: Explorer, task: asyncio.Task[None]) -> None:
    _open.pop(explorer, None)
    if not task.cancelled() and task.exception() is not None:
        logging.getLogger(__name__).error("the explorer's page ended: %s", task.exception())


def _free_port() -> int:
    """Choose the port before the server starts, because the link is shown first."""
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
    """A page for notebooks, plain text for anything else."""

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
