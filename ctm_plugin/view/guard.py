"""What viser's web server lets through.

By itself it lets pages of other sites connect, also where the site's name was made to mean this machine (DNS
rebinding), asks nobody who comes from another machine, and its page loads a script for statistics from elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from hmac import compare_digest
from http.cookies import SimpleCookie
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
def guarded(token: str | None) -> Iterator[None]:
    """A server that viser starts inside refuses what is not :func:`admitted` and sends ``POLICY`` with its pages.

    Args:
        token: what the page must be asked for with, as ``/?token=TOKEN``; the browser then keeps it as a cookie.
            ``None``: the server listens only to this machine.
    """
    serve = websockets_server.serve

    def with_guard(*args: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            if not admitted(request.path, request.headers, token):
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


def admitted(path: str, headers: Mapping[str, str], token: str | None) -> bool:
    """Whether to answer a request: it comes from the server's own page or from none, and it has the token.

    Without a token the server has this machine's own names only: another name may be another site's.
    """
    host, origin = headers.get("Host", ""), headers.get("Origin")
    if origin is not None and urlsplit(origin).netloc != host:
        return False
    if token is None:
        return is_local(urlsplit(f"//{host}").hostname or "")
    cookie = SimpleCookie(headers.get("Cookie", "")).get(COOKIE)
    given = [*parse_qs(urlsplit(path).query).get("token", []), cookie.value if cookie else ""]
    return any(compare_digest(each.encode(), token.encode()) for each in given)


def is_local(host: str) -> bool:
    """Whether a host is ``localhost`` or an address of the loopback, which no other machine reaches."""
    try:
        return ip_address("127.0.0.1" if host == "localhost" else host).is_loopback
    except ValueError:
        return False
