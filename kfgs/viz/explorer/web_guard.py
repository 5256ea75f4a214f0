"""Who may reach the explorer's page: whoever has its link, from the page itself."""

from __future__ import annotations

import hmac
from collections.abc import Awaitable, Callable
from ipaddress import ip_address
from typing import Any
from urllib.parse import urlsplit

REFUSED = "This page opens with the whole link that kfgs gave.\n"


def is_loopback(host: str) -> bool:
    """Whether a server that listens there is reached from this machine only."""
    try:
        return ip_address(host.strip("[]")).is_loopback
    except ValueError:  # a name
        return host.lower() == "localhost"


def make_guard(secret: str, host: str) -> Callable[[Any, Callable[[Any], Awaitable[Any]]], Awaitable[Any]]:
    """A middleware of aiohttp for a page whose whole address begins with /secret/.

    Refused with 403, before anything is read: a path without the secret; a request, such as a websocket of another page,
    whose Origin is not the page's own; and, while only this machine is listened to, another machine's name in Host (a
    name that was made to point at 127.0.0.1). Refused with 400: the websocket's address, opened as a page, which wslink
    stumbles over. Answers, refusals too, forbid the browser to load anything from elsewhere.

    Args:
        secret: what only the link tells.
        host: the address listened on.
    """
    from aiohttp import web

    local = is_loopback(host)

    def check(request: Any) -> None:
        first = request.path.split("/")[1]
        if not hmac.compare_digest(first.encode(), secret.encode()):
            raise web.HTTPForbidden(text=REFUSED)
        if local and not is_loopback(urlsplit(f"//{request.host}").hostname or ""):
            raise web.HTTPForbidden(text=REFUSED)
        origin = request.headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc.lower() != request.host.lower():
            raise web.HTTPForbidden(text=REFUSED)
        if request.path == f"/{secret}/ws" and not web.WebSocketResponse().can_prepare(request).ok:
            raise web.HTTPBadRequest(text="This address is the page's own.\n")

    @web.middleware
    async def guard(request: Any, handler: Callable[[Any], Awaitable[Any]]) -> Any:
        try:
            check(request)
            response = await handler(request)
        except web.HTTPException as refusal:
            refusal.headers.update(_headers(request.host))
            raise
        except ConnectionError:  # the tab was closed in the midst of a picture
            return web.Response()
        if not response.prepared:  # a websocket is under way
            response.headers.update(_headers(request.host))
        return response

    return guard


def _headers(host: str) -> dict[str, str]:
    """What a browser may load: only from here. Vue compiles the page's template, hence unsafe-eval."""
    policy = {
        "default-src": "'self'",
        "script-src": "'self' 'unsafe-inline' 'unsafe-eval'",
        "style-src": "'self' 'unsafe-inline'",
        "img-src": "'self' blob: data:",
        "connect-src": f"'self' ws://{host} wss://{host} blob: data:",
        "form-action": "'none'",
        "base-uri": "'self'",
    }
    return {
        "Content-Security-Policy": "; ".join(f"{name} {value}" for name, value in policy.items()),
        "Referrer-Policy": "no-referrer",  # the address is the secret
        "X-Content-Type-Options": "nosniff",
        "Cache-Control": "no-cache",
    }
