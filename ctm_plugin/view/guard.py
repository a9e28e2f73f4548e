"""What viser's web server lets through.

By itself it serves files from outside its folder (``GET /../../..``), lets pages of other sites connect, also where the
site's name was made to mean this machine (DNS rebinding), and its page loads a script for statistics from elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from hmac import compare_digest
from ipaddress import ip_address
from typing import Any
from urllib.parse import parse_qs, urlsplit

import websockets.asyncio.server as websockets_server

POLICY = (
    "default-src 'self' data: blob:; "
    "script-src 'self' 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob:; "
    "style-src 'self' 'unsafe-inline'"
)
"""The browser is to load nothing from other hosts than the page's."""


COOKIE = "ctm_view"


@contextmanager
def guarded(at: str, token: str | None = None) -> Iterator[None]:
    """A server that viser starts inside, listening at ``at``, refuses what is not :func:`allowed` and sends ``POLICY``
    with its pages.

    Args:
        at: host.
        token: what the page must be asked for with, as ``/?token=TOKEN``; the browser then keeps it as a cookie.
    """
    serve, local = websockets_server.serve, is_local(at)

    def with_guard(*args: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            headers = request.headers
            if not allowed(request.path, headers.get("Origin"), headers.get("Host", ""), local):
                return connection.respond(403, "refused\n")
            if token is not None and not admitted(request.path, headers.get("Cookie", ""), token):
                return connection.respond(403, "this page wants the whole address that `ctm view` printed\n")
            response = process_request(connection, request)
            if response is not None:
                response.headers["Content-Security-Policy"] = POLICY
                if token is not None:
                    response.headers["Set-Cookie"] = f"{COOKIE}={token}; Path=/; HttpOnly; SameSite=Strict"
                    response.headers["Referrer-Policy"] = "no-referrer"
            return response

        return serve(*args, process_request=answer, **options)

    websockets_server.serve = with_guard
    try:
        yield
    finally:
        websockets_server.serve = serve


def admitted(path: str, cookies: str, token: str) -> bool:
    """Whether a request has the token, in its query or in one of its cookies of that name."""
    named = [
        value for name, _, value in (cookie.strip().partition("=") for cookie in cookies.split(";")) if name == COOKIE
    ]
    given = [*parse_qs(urlsplit(path).query).get("token", []), *named]
    return any(compare_digest(each.encode(), token.encode()) for each in given)


def allowed(path: str, origin: str | None, host: str, local: bool) -> bool:
    """Whether to answer a request: its path stays in the folder, and it comes from the server's own page or from none.

    Args:
        path: as requested, with its query.
        origin, host: the headers.
        local: the server listens only to this machine, under its names: another name may be another site's.
    """
    inside = path.startswith("/") and not path.startswith("//") and ".." not in path and "\\" not in path
    known = not local or is_local(urlsplit(f"//{host}").hostname or "")
    return inside and known and (origin is None or urlsplit(origin).netloc == host)


def is_local(host: str) -> bool:
    """Whether a host is ``localhost`` or an address of the loopback, which no other machine reaches."""
    try:
        return ip_address("127.0.0.1" if host == "localhost" else host).is_loopback
    except ValueError:
        return False
