"""The explorer in a browser: a server on this machine; only who has its link can open the page."""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import logging
import os
import secrets
import socket
import sys
import webbrowser
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

from ..._check import check_whole, error_line
from ..headless import has_display
from .web_guard import is_loopback, make_guard
from .web_page import ExplorerPage

if TYPE_CHECKING:
    from .explorer import Explorer

MODULES = ("trame", "trame_vtk", "aiohttp")


def require_web() -> None:
    """Raise an ImportError with the install line if the extra `web` is missing."""
    missing = [name for name in MODULES if importlib.util.find_spec(name) is None]
    if missing:
        raise ImportError(
            f"where: expected the extra 'web' for a page in the browser, got no {', '.join(missing)}; "
            'pip install "kfgs[web]"'
        )


def serve(
    explorer: Explorer,
    host: str = "127.0.0.1",
    port: int = 0,
    open_browser: bool = True,
    *,
    report: Callable[[str], object] | None = None,
) -> None:
    """Show an explorer in the browser until Ctrl-C or `explorer.close()`. A closed tab can be opened again by its link.

    By default the page can be reached from this machine only. Its link holds a secret, so other pages in the same browser
    and other users of the machine are refused. Several tabs show the same state and the same picture, in the size of the
    tab that was resized last. The page saves into `ExploreOptions.out`; the browser cannot choose file names.

    Args:
        explorer: one that draws off-screen.
        host: address to listen on. With an address that other machines can reach, everyone who has the link can look,
            change what all see, and save pictures and selections here; nothing is encrypted.
        port: port of the page; 0: a free one.
        open_browser: open the link in the default browser, if there is a display.
        report: called with the link and hints, line by line; None: standard error.

    Raises:
        ImportError: if the extra `web` is missing.
        ValueError: if the address is not one of this machine, or the port is taken.
        RuntimeError: if an event loop already runs, as in a notebook, or the explorer is closed.
    """
    require_web()
    check_whole("port", port, 0, 65535)
    if loop_runs():
        raise RuntimeError(
            "serve: expected no running event loop, got one, as in a notebook; use show_in_notebook or where='notebook'"
        )
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(_serve(explorer, host, port, open_browser, report or _to_stderr))


def require_open(explorer: Explorer) -> None:
    """Raise a RuntimeError if the explorer is closed."""
    if explorer.closed:
        raise RuntimeError(
            "explorer: expected an open one to show, got one that is closed; make another with explore(...) or "
            "Explorer(explorer.state)"
        )


async def _serve(explorer: Explorer, host: str, port: int, open_browser: bool, report: Callable[[str], object]) -> None:
    async with Listening(explorer, host, port) as listening:
        report(f"the explorer is open at {listening.url}")
        if not is_loopback(host):
            report(
                f"note: it listens on {host}: everyone who reaches it and has the link can look, steer, and save pictures "
                f"and selections into {explorer.options.out}; nothing on the way is encrypted"
            )
        report("Ctrl-C ends it; closing the tab does not")
        if open_browser and has_display():  # without a display, Python would open a browser in the terminal
            webbrowser.open(listening.url)
        await listening.ended()


class Listening:
    """An async context that serves the page in the running event loop; arguments as in `serve`.

    Raises:
        ValueError: if `host` is empty; on entering, if it is no address of this machine or the port is taken.
        RuntimeError: if the explorer is closed.
    """

    def __init__(self, explorer: Explorer, host: str, port: int) -> None:
        require_open(explorer)
        if not host.strip():  # aiohttp would listen to everyone
            raise ValueError(
                f"host: expected an address of this machine, got {host!r}; 127.0.0.1 is for this machine alone, 0.0.0.0 "
                "for everyone"
            )
        self.secret = secrets.token_urlsafe(24)
        self._explorer, self._host, self._port = explorer, host, port
        self._name = f"kfgs-{secrets.token_hex(8)}"
        self._tasks: list[asyncio.Task[Any]] = []
        self._quiet, self._closed = contextlib.ExitStack(), asyncio.Event()

    async def __aenter__(self) -> Listening:
        from trame.app import get_server
        from trame_client import module  # type: ignore[import-untyped]
        from trame_client.module import vue3  # type: ignore[import-untyped]

        self._server = server = get_server(self._name, client_type="vue3")
        self.page = ExplorerPage(self._explorer, server)
        server.enable_module(module)
        # every path, the websocket's too, begins with /secret/, so a reload keeps the secret
        server.serve = {f"{self.secret}/{place}": folder for place, folder in server.serve.items()}
        server.serve[self.secret] = vue3.www
        server.controller.on_server_bind.add(self._guard)
        with _own_arguments(f"--ws-endpoint={self.secret}/ws"):
            serving = server.start(
                exec_mode="coroutine", host=self._host, port=self._port, open_browser=False, show_connection_info=False,
                disable_logging=True, backend="aiohttp", thread=True, timeout=0,
            )  # fmt: skip
        ready = server.ready
        task = asyncio.ensure_future(serving)
        await asyncio.wait([task, ready], return_when=asyncio.FIRST_COMPLETED)
        if task.done():
            self._forget()
            raise _refused(self._host, self._port, task.exception())
        self._tasks = [task, asyncio.ensure_future(self.page.work())]
        self._quiet.enter_context(_closed_tabs())
        self._explorer.set_legend(False)  # the page lists the classes itself
        self._explorer.on_close(partial(self._leave, asyncio.get_running_loop()))
        return self

    @property
    def url(self) -> str:
        """The link of the page, with the secret."""
        name = socket.gethostname() if self._host in ("0.0.0.0", "::") else self._host
        name = f"[{name}]" if ":" in name else name
        return f"http://{name}:{self._port or self._server.port}/{self.secret}/index.html"

    async def ended(self) -> None:
        """Wait until the server stops, or the explorer is closed."""
        closed = asyncio.ensure_future(self._closed.wait())
        try:  # a plain await would pass a cancellation on to wslink, which cannot handle it
            await asyncio.wait([self._tasks[0], closed], return_when=asyncio.FIRST_COMPLETED)
        finally:
            closed.cancel()

    async def __aexit__(self, *_: object) -> None:
        self._explorer.set_legend(True)
        serving, work = self._tasks
        work.cancel()
        await asyncio.wait([work])
        if not serving.done():
            await self._server.stop()
            await serving
        self._quiet.close()
        self._forget()
        del (
            self._explorer,
            self.page.explorer,
            self.page.pictures,
            self.page.view,
        )  # trame keeps the widgets for ever, and they refer to the page

    def _leave(self, loop: asyncio.AbstractEventLoop) -> None:
        """Called when the explorer closes: perhaps in another thread, perhaps long after the page ended."""
        if not loop.is_closed():
            loop.call_soon_threadsafe(self._closed.set)

    def _guard(self, wslink: Any, **_: Any) -> None:
        wslink.app.middlewares.append(make_guard(self.secret, self._host))
        self._server.protocol.stopServer = lambda: None  # else any tab could stop the server

    def _forget(self) -> None:
        """Remove the server from trame, which keeps every server for ever."""
        from trame.app.core import AVAILABLE_SERVERS
        from trame_server.protocol import CoreServer  # type: ignore[import-untyped]
        from trame_vtk.modules.vtk import HELPERS_PER_SERVER

        if CoreServer.server is self._server:
            CoreServer.server = None
        AVAILABLE_SERVERS.pop(self._name, None)
        HELPERS_PER_SERVER.pop(self._name, None)


@contextlib.contextmanager
def _own_arguments(arguments: str) -> Iterator[None]:
    """Give trame these arguments. It would read the command line of the program."""
    before = os.environ.get("TRAME_ARGS")
    os.environ["TRAME_ARGS"] = arguments
    try:
        yield
    finally:
        if before is None:
            del os.environ["TRAME_ARGS"]
        else:
            os.environ["TRAME_ARGS"] = before


@contextlib.contextmanager
def _closed_tabs() -> Iterator[None]:
    """Hide the errors of a tab that is closed while a picture is sent to it. wslink and asyncio would print them."""
    loop, logger = asyncio.get_running_loop(), logging.getLogger("wslink.protocol")
    before = loop.get_exception_handler()

    def handle(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        if not isinstance(context.get("exception"), ConnectionError):
            (before or type(loop).default_exception_handler)(loop, context)  # type: ignore[operator]

    def filter_(_: logging.LogRecord) -> bool:
        return not isinstance(sys.exc_info()[1], ConnectionError)

    loop.set_exception_handler(handle)
    logger.addFilter(filter_)
    try:
        yield
    finally:
        logger.removeFilter(filter_)
        loop.set_exception_handler(before)


def _refused(host: str, port: int, error: BaseException | None) -> BaseException:
    if isinstance(error, OSError):
        return ValueError(
            f"host, port: expected an address of this machine and a port that is free, got {host!r} and {port} "
            f"({error_line(error)}); choose another, or port 0"
        )
    return error or RuntimeError("serve: expected a server that runs, got one that ended at once; set another port")


def loop_runs() -> bool:
    """Whether an event loop runs in this thread."""
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return False
    return True


def _to_stderr(line: str) -> None:
    sys.stderr.write(line + "\n")
    sys.stderr.flush()
