"""A small web server on this machine for one page: the page, the scene that it shows, and the calls that its script makes.

Only who has the link is answered: the path begins with a secret, a request from another page (Origin) or with another
machine's name (Host) is refused before anything is read, and the browser may load nothing from elsewhere. Every request
has a thread of its own, which ends with it; so a tab that reads slowly holds up no other, and closing leaves nothing behind.
"""

from __future__ import annotations

import hmac
import json
import secrets
import socket
import struct
import sys
import time
import zlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from ipaddress import ip_address
from threading import Event, Thread
from typing import Any
from urllib.parse import SplitResult, urlsplit

from .._card import error_line
from .._files import parse_json

REFUSED = "This page opens with the whole link that kfgs gave.\n"
LONGEST_CALL = 16 << 20
"""Bytes: a selection of many million Gaussians, as bits."""
PATIENCE = 60.0
"""Seconds after which a connection is closed that neither sends nor reads, or that has not shown the secret."""
STRANGERS = 64
"""Most connections that have not shown the secret; the oldest is closed for a new one."""
PAUSE = 0.1
"""Seconds until a connection is accepted for which no file handle is left."""
POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' blob:; style-src 'unsafe-inline'; img-src 'self' blob: data:; "
    "connect-src 'self'; worker-src blob:; form-action 'none'; base-uri 'none'; frame-ancestors 'self'"
)

Call = Callable[[str, dict[str, Any], bytes], tuple[dict[str, Any], bytes]]
"""(name, arguments, attached bytes) -> answer and attached bytes. A ValueError or TypeError is told to the page."""


class PageServer:
    """Serves a page from a thread of its own, until `close` or the end of a `with` block.

    The page is there at once; who asks for the scene waits until `show`, and who calls until `show` with an answer. So the
    browser starts while Python loads.
    A call is a POST to `call`: 4 bytes with the length of a JSON text (little-endian), the JSON {"name", "args"}, and
    attached bytes; the answer has the same form.

    Args:
        document: the page, HTML.
        host: address to listen on. With one that other machines can reach, everyone who has the link can look and save.
        port: 0 to 65535; 0: a free one.

    Raises:
        ValueError: if the address is not one of this machine, or the port is taken.
    """

    def __init__(self, document: str, host: str = "127.0.0.1", port: int = 0) -> None:
        if not host.strip():
            raise ValueError(
                f"host: expected an address of this machine, got {host!r}; 127.0.0.1 is for this machine alone, 0.0.0.0 "
                "for everyone"
            )
        self.secret = secrets.token_urlsafe(24)
        self._host = host
        self._document = document.encode()
        self._pack = b""
        self._call: Call = _no_answer
        self._shown, self._loaded, self._closed = Event(), Event(), Event()
        handler = type("Handler", (_Handler,), {"page": self})
        try:
            self._server = _server_class(host)((host.strip("[]"), port), handler)
        except (OSError, OverflowError) as error:  # OverflowError: a port above 65535
            raise ValueError(
                f"host, port: expected an address of this machine and a port that is free, got {host!r} and {port} "
                f"({error_line(error)}); choose another, or port 0"
            ) from error
        self._thread = Thread(target=self._server.serve_forever, name="kfgs-page", daemon=True)
        self._thread.start()

    def show(self, pack: bytes, call: Call | None = None) -> None:
        """Give the page its scene, and what answers its calls.

        Args:
            pack: the scene, for `readMessage` of link.js.
            call: answers calls, in several threads at once. None: this scene was kept from an earlier time, and Python still
                loads; calls wait. If the scene then is another one, the page loads itself again.
        """
        self._pack = pack
        self._shown.set()
        if call is not None:
            self._call = call
            self._loaded.set()

    def file(self, name: str) -> tuple[str, bytes] | None:
        """Media type and content of a file; None for others than these, and after the end.

        - "": the page
        - "pack": the scene, as soon as there is one
        - "version": which scene Python shows once it has loaded, as "pack" has it in its header `ETag`
        """
        if name == "":
            return "text/html; charset=utf-8", self._document
        if name == "pack" and self._wait(self._shown):
            return "application/octet-stream", self._pack
        if name == "version" and self._wait(self._loaded):
            return "text/plain", version_of(self._pack).encode()
        return None

    def answer(self, read: Callable[[], tuple[Mapping[str, Any], bytes]]) -> tuple[dict[str, Any], bytes]:
        """Answer a call of the page when Python has loaded; see `answer_call`."""
        self._wait(self._loaded)
        return answer_call(self._call, read)

    def _wait(self, event: Event) -> bool:
        """Whether it happens, sooner or later."""
        while not event.wait(0.05) and not self._closed.is_set():
            pass
        return event.is_set()

    @property
    def url(self) -> str:
        """The link of the page, with the secret."""
        name = socket.gethostname() if self._host in ("0.0.0.0", "::") else self._host.strip("[]")
        name = f"[{name}]" if ":" in name else name
        return f"http://{name}:{self._server.server_address[1]}/{self.secret}/"

    @property
    def local(self) -> bool:
        """Whether it can be reached from this machine only."""
        return is_loopback(self._host)

    def close(self) -> None:
        """Stop listening; a second call does nothing."""
        self._closed.set()
        if self._thread.is_alive():
            self._server.shutdown()
            self._thread.join()
        self._server.server_close()

    def __enter__(self) -> PageServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def version_of(content: bytes) -> str:
    """What tells one content from another."""
    return f'"{zlib.crc32(content):08x}"'


def is_loopback(host: str) -> bool:
    """Whether a server on this address can be reached from this machine only."""
    try:
        return ip_address(host.strip("[]")).is_loopback
    except ValueError:  # a name
        return host.lower() == "localhost"


def pack_message(answer: Mapping[str, Any], attached: bytes = b"") -> bytes:
    """A JSON text with its length before it, and bytes after it."""
    text = json.dumps(answer).encode()
    return struct.pack("<I", len(text)) + text + attached


def read_message(message: bytes) -> tuple[dict[str, Any], bytes]:
    """The inverse of `pack_message`; a ValueError for anything else."""
    if len(message) < 4:
        raise ValueError(f"message: expected at least 4 bytes, got {len(message)}; send what the page's script makes")
    (length,) = struct.unpack_from("<I", message)
    try:
        answer = parse_json(message[4 : 4 + length])
    except ValueError as error:
        raise ValueError(
            f"message: expected JSON ({type(error).__name__}); send what the page's script makes"
        ) from None
    if length > len(message) - 4 or not isinstance(answer, dict):
        raise ValueError("message: expected an object and its length, got others; send what the page's script makes")
    return answer, message[4 + length :]


def answer_call(call: Call, read: Callable[[], tuple[Mapping[str, Any], bytes]]) -> tuple[dict[str, Any], bytes]:
    """Read a call, {"name", "args"} and attached bytes, and answer it; whatever fails is told to the page, and Python goes on."""
    try:
        asked, attached = read()
        args = asked.get("args") or {}
        if not isinstance(args, Mapping):
            raise ValueError(f"args: expected an object, got {args!r:.80}; send what the page's script makes")
        return call(str(asked.get("name")), dict(args), attached)
    except Exception as error:
        return _error_answer(error)


def _error_answer(error: Exception) -> tuple[dict[str, Any], bytes]:
    """What the page is told instead of an answer. The type is named only if the error is not about the arguments."""
    about_arguments = isinstance(error, ValueError | TypeError | OSError) and str(error)
    return {"error": str(error) if about_arguments else error_line(error)}, b""


def _no_answer(*_: object) -> tuple[dict[str, Any], bytes]:
    raise ValueError("Python ended before it had loaded the scene; its terminal says why")


def _server_class(host: str) -> type[ThreadingHTTPServer]:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    return type("Server", (_Server,), {"address_family": family})


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._strangers: dict[
            socket.socket, float
        ] = {}  # until when each has time to show the secret, the oldest first
        super().__init__(*args, **kwargs)

    def get_request(self) -> tuple[socket.socket, Any]:
        try:
            return super().get_request()
        except OSError:  # no file handle is left; the connection waits, and asking again at once would only burn time
            self._hang_up(1)
            time.sleep(PAUSE)
            raise

    def process_request(self, request: Any, client_address: Any) -> None:
        self._strangers[request] = time.monotonic() + PATIENCE
        self._hang_up(len(self._strangers) - STRANGERS)
        super().process_request(request, client_address)

    def service_actions(self) -> None:
        now = time.monotonic()
        self._hang_up(sum(until < now for until in list(self._strangers.values())))

    def know(self, request: Any) -> None:
        """A connection has shown the secret: it may take its time."""
        self._strangers.pop(request, None)

    def shutdown_request(self, request: Any) -> None:
        self.know(request)
        super().shutdown_request(request)

    def _hang_up(self, count: int) -> None:
        """End the oldest connections that have not shown the secret; their threads find the end of the request."""
        for request in list(self._strangers)[: max(count, 0)]:
            self.know(request)
            with suppress(OSError):
                request.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """One line for a bug of ours; nothing if the browser hung up."""
        error = sys.exception()
        if isinstance(error, Exception) and not isinstance(error, OSError):
            sys.stderr.write(f"kfgs: a request of the page failed: {error_line(error)}\n")


class _Handler(BaseHTTPRequestHandler):
    page: PageServer
    server: _Server
    timeout = PATIENCE

    def do_GET(self) -> None:
        name = self._name()
        if name is None:
            return
        found = self.page.file(name)
        if found is None:
            self._answer(404, "text/plain", b"There is no such file.\n")
        else:
            self._answer(200, *found)

    def do_POST(self) -> None:
        name = self._name()
        if name is None:
            return
        length = self.headers.get("Content-Length", "")
        if name != "call" or not length.isdecimal() or len(length) > 20 or int(length) > LONGEST_CALL:
            self._answer(400, "text/plain", b"This address is the page's own.\n")
            return
        answer = self.page.answer(lambda: read_message(self.rfile.read(int(length))))
        self._answer(200, "application/octet-stream", pack_message(*answer))

    def _name(self) -> str | None:
        """The file asked for; None if the request was refused."""
        parts = _split(self.path).path.split("/", 2)
        host, origin = self.headers.get("Host", ""), self.headers.get("Origin")
        allowed = len(parts) == 3 and hmac.compare_digest(parts[1].encode(), self.page.secret.encode())
        if self.page.local and not is_loopback(_split(f"//{host}").hostname or ""):
            allowed = False
        if origin is not None and _split(origin).netloc.lower() != host.lower():
            allowed = False
        if not allowed:
            self._answer(403, "text/plain", REFUSED.encode())
            return None
        self.server.know(self.request)
        return parts[2]

    def _answer(self, status: int, kind: str, content: bytes) -> None:
        try:
            self.send_response(status)
            headers = {
                "Content-Type": kind,
                "Content-Length": str(len(content)),
                "ETag": version_of(content),
                "Content-Security-Policy": POLICY,
                "Referrer-Policy": "no-referrer",  # the address holds the secret
                "X-Content-Type-Options": "nosniff",
                "Cache-Control": "no-store",
            }
            for name, value in headers.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(content)
        except (ConnectionError, TimeoutError):  # the tab was closed while it loaded
            self.close_connection = True

    def log_message(self, *_: Any) -> None:
        """Say nothing: addresses hold the secret."""


def _split(address: str) -> SplitResult:
    try:
        return urlsplit(address)
    except ValueError:  # brackets that do not match, as in http://[
        return urlsplit("")
