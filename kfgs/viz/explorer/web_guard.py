"""Protect the explorer's page: only requests with its secret link, from the page itself, are answered."""

from __future__ import annotations

import hmac
from collections.abc import Awaitable, Callable
from ipaddress import ip_address
from typing import Any
from urllib.parse import urlsplit

REFUSED = "This page opens with the whole link that kfgs gave.\n"


def is_loopback(host: str) -> bool:
    """Whether a server on this address can be reached from this machine only."""
    try:
        return ip_address(host.strip("[]")).is_loopback
    except ValueError:  # a name
        return host.lower() == "localhost"


def make_guard(secret: str, host: str) -> Callable[[Any, Callable[[Any], Awaitable[Any]]], Awaitable[Any]]:
    """An aiohttp middleware for a page whose address begins with /secret/.

    Status 403, before anything is read: a path without the secret; an Origin other than the page (for instance a
    websocket of another page); and, if the server listens on this machine only, a Host that names another machine (a
    name made to point at 127.0.0.1). Status 400: the websocket's address opened as a page, which wslink cannot handle.
    Every answer forbids the browser to load anything from elsewhere.

    Args:
        secret: known only from the link.
        host: the address the server listens on.
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
        except ConnectionError:  # the tab was closed while it loaded a picture
            return web.Response()
        if not response.prepared:  # the headers of a websocket were sent before
            response.headers.update(_headers(request.host))
        return response

    return guard


def _headers(host: str) -> dict[str, str]:
    """Headers that allow the browser to load from here only. Vue compiles the page's template: hence unsafe-eval."""
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
        "Referrer-Policy": "no-referrer",  # the address holds the secret
        "X-Content-Type-Options": "nosniff",
        "Cache-Control": "no-cache",
    }
