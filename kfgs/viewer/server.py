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
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from ipaddress import ip_address
from threading import Thread
from typing import Any
from urllib.parse import urlsplit

from .._card import error_line
from .._files import parse_json

LONGEST_CALL = 16 << 20  # bytes: a selection of many million Gaussians, as bits
LONGEST_FILE = 1 << 29  # bytes of a call that opens a file; app.js has the same number
MOST_SCENES = 4  # that a server holds, in the memory of Python: its own, and the last that were opened
PATIENCE = 60.0  # seconds after which a connection that neither sends nor reads is closed
POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' blob:; style-src 'unsafe-inline'; img-src 'self' blob: data:; "
    "connect-src 'self'; worker-src blob:; form-action 'none'; base-uri 'none'; frame-ancestors 'self'"
)

Call = Callable[[str, dict[str, Any], bytes], tuple[dict[str, Any], bytes]]
"""(name, arguments, attached bytes) -> answer and attached bytes. The page shows the message of a ValueError or TypeError."""


class PageServer(AbstractContextManager["PageServer"]):
    """Serves a page (HTML) and its scene (for `readMessage` of link.js) from a thread of its own, until `close`.

    A call is a POST to `call`: 4 bytes with the length of a JSON text (little-endian), the JSON {"name", "args"}, and
    attached bytes; the answer has the same form. With a host that other machines can reach, everyone who has the link can
    look and save. Port 0 is a free one; a ValueError if it is taken, or the host is not one of this machine.

    The call "open", with the name of a file and its bytes, is answered with the secret of a page that shows it, which
    `open_file` makes. Only a page that this machine alone can reach may open files.
    """

    def __init__(
        self, document: str, pack: bytes, call: Call, host: str = "127.0.0.1", port: int = 0,
        *, open_file: Callable[[str, bytes], tuple[str, bytes, Call]] | None = None,
    ) -> None:  # fmt: skip
        if not host.strip():
            raise ValueError(f"host: expected an address of this machine, got {host!r}; for instance 127.0.0.1")
        self.scenes: dict[str, tuple[dict[str, tuple[str, bytes]], Call]] = {}
        self.secret = self.add(document, pack, call)
        self._host, self._open_file = host, open_file
        handler = type("Handler", (_Handler,), {"page": self})
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            self._server = type("Server", (_Server,), {"address_family": family})((host.strip("[]"), port), handler)
        except (OSError, OverflowError) as error:  # OverflowError: a port above 65535
            raise ValueError(
                f"host, port: expected an address of this machine and a port that is free, got {host!r} and {port} "
                f"({error_line(error)}); choose another, or port 0"
            ) from error
        self._thread = Thread(target=self._server.serve_forever, name="kfgs-page", daemon=True)
        self._thread.start()

    def add(self, document: str, pack: bytes, call: Call) -> str:
        """Serve one more page, and no longer the first of those that were added if they are too many; returns its secret."""
        secret = secrets.token_urlsafe(24)
        files = {"": ("text/html; charset=utf-8", document.encode()), "pack": ("application/octet-stream", pack)}
        self.scenes[secret] = files, partial(self._call, call)
        for old in list(self.scenes)[1 : 1 - MOST_SCENES]:  # several, if files are dropped at the same time
            self.scenes.pop(old, None)
        return secret

    def _call(self, own: Call, name: str, args: dict[str, Any], attached: bytes) -> tuple[dict[str, Any], bytes]:
        if name != "open":
            return own(name, args, attached)
        if self._open_file is None or not self.local:
            raise ValueError("file: expected a page that only this machine can open, got another; run `kfgs view FILE`")
        return {"secret": self.add(*self._open_file(str(args.get("name")), attached))}, b""

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
        if self._thread.is_alive():
            self._server.shutdown()
            self._thread.join()
        self._server.server_close()

    def __exit__(self, *_: object) -> None:
        self.close()


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
    (length,) = struct.unpack_from("<I", message) if len(message) >= 4 else (len(message),)
    try:
        answer = parse_json(message[4 : 4 + length])
    except ValueError:
        answer = None
    if length > len(message) - 4 or not isinstance(answer, dict):
        raise ValueError("message: expected an object in JSON after its length, got others; send what the page makes")
    return answer, message[4 + length :]


def answer_call(call: Call, read: Callable[[], tuple[Mapping[str, Any], bytes]]) -> tuple[dict[str, Any], bytes]:
    """Read a call, {"name", "args"} and attached bytes, and answer it; the page shows whatever fails, and Python continues."""
    try:
        asked, attached = read()
        args = asked.get("args") or {}
        if not isinstance(args, Mapping):
            raise ValueError(f"args: expected an object, got {args!r:.80}; send what the page's script makes")
        return call(str(asked.get("name")), dict(args), attached)
    except Exception as error:
        # the type is named only if the error is not about the arguments
        about_arguments = isinstance(error, ValueError | TypeError | OSError) and str(error)
        return {"error": str(error) if about_arguments else error_line(error)}, b""


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def handle_error(self, request: Any, client_address: Any) -> None:
        """One line for a bug of ours; nothing if the browser hung up."""
        error = sys.exception()
        if isinstance(error, Exception) and not isinstance(error, OSError):
            sys.stderr.write(f"kfgs: a request of the page failed: {error_line(error)}\n")


class _Handler(BaseHTTPRequestHandler):
    page: PageServer
    timeout = PATIENCE

    def do_GET(self) -> None:
        name = self._name()
        if name is not None:
            files, missing = self.scene[0], ("text/plain", b"There is no such file.\n")
            self._answer(200 if name in files else 404, *files.get(name, missing))

    def do_POST(self) -> None:
        name = self._name()
        if name is None:
            return
        length, longest = self.headers.get("Content-Length", ""), LONGEST_FILE if self.page.local else LONGEST_CALL
        if name != "call" or not length.isdecimal() or len(length) > 20 or int(length) > longest:
            self._answer(400, "text/plain", b"This address is the page's own.\n")
            return
        answer = answer_call(self.scene[1], lambda: read_message(self.rfile.read(int(length))))
        self._answer(200, "application/octet-stream", pack_message(*answer))

    def _name(self) -> str | None:
        """The file asked for; None if the request was refused."""
        host = self.headers.get("Host", "")
        origin = self.headers.get("Origin", f"//{host}")
        try:
            _, asked, name = urlsplit(self.path).path.split("/", 2)
            machine, source = urlsplit(f"//{host}").hostname or "", urlsplit(origin).netloc
        except ValueError:  # too few parts, or brackets that do not match, as in http://[
            asked, name, machine, source = "", "", "", ""
        scenes = list(self.page.scenes.items())
        allowed = [own for secret, own in scenes if hmac.compare_digest(asked.encode(), secret.encode())]
        if allowed and source.lower() == host.lower() and (not self.page.local or is_loopback(machine)):
            self.scene = allowed[0]
            return name
        self._answer(403, "text/plain", b"This page opens with the whole link that kfgs gave.\n")
        return None

    def _answer(self, status: int, kind: str, content: bytes) -> None:
        headers = {
            "Content-Type": kind,
            "Content-Length": str(len(content)),
            "Content-Security-Policy": POLICY,
            "Referrer-Policy": "no-referrer",  # the address holds the secret
            "X-Content-Type-Options": "nosniff",
            "Cache-Control": "no-store",
        }
        try:
            self.send_response(status)
            for name, value in headers.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(content)
        except (ConnectionError, TimeoutError):  # the tab was closed while it loaded
            self.close_connection = True

    def log_message(self, *_: Any) -> None:
        """Say nothing: addresses hold the secret."""
