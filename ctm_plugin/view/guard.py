"""What viser's web server lets through.

By itself it serves files from outside its folder (``GET /../../..``), lets pages of other sites connect, also where the
site's name was made to mean this machine (DNS rebinding), and its page loads a script for statistics from elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import Any
from urllib.parse import urlsplit

import websockets.asyncio.server as websockets_server

POLICY = (
    "default-src 'self' data: blob:; "
    "script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:; "
    "style-src 'self' 'unsafe-inline'"
)
"""The browser is to load nothing from other hosts than the page's."""


@contextmanager
def guarded(at: str) -> Iterator[None]:
    """A server that viser starts inside, listening at ``at``, refuses what is not :func:`allowed` and sends ``POLICY``
    with its pages."""
    serve, listens = websockets_server.serve, address(at)
    local = listens is not None and listens.is_loopback

    def with_guard(*args: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            if not allowed(request.path, request.headers.get("Origin"), request.headers.get("Host", ""), local):
                return connection.respond(403, "refused\n")
            response = process_request(connection, request)
            if response is not None:
                response.headers["Content-Security-Policy"] = POLICY
            return response

        return serve(*args, process_request=answer, **options)

    websockets_server.serve = with_guard
    try:
        yield
    finally:
        websockets_server.serve = serve


def allowed(path: str, origin: str | None, host: str, local: bool) -> bool:
    """Whether to answer a request: its path stays in the folder, and it comes from the server's own page or from none.

    Args:
        path: as requested, with its query.
        origin, host: the headers.
        local: the server listens to this machine alone, and is asked for by address: a name may be another site's.
    """
    inside = path.startswith("/") and not path.startswith("//") and ".." not in path and "\\" not in path
    known = not local or address(urlsplit(f"//{host}").hostname or "") is not None
    return inside and known and (origin is None or urlsplit(origin).netloc == host)


def address(host: str) -> IPv4Address | IPv6Address | None:
    """The address that a host is given by, ``localhost`` included; ``None`` for names."""
    try:
        return ip_address("127.0.0.1" if host == "localhost" else host)
    except ValueError:
        return None
