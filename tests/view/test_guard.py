"""What the web server refuses."""

from types import SimpleNamespace
from unittest.mock import patch

import pytest
import websockets.asyncio.server as websockets_server

from ctm_plugin.view.guard import admitted, allowed, guarded


@pytest.mark.parametrize(
    ("path", "origin", "host"),
    [
        ("/", None, "127.0.0.1:8080"),
        ("/", None, "LOCALHOST"),
        ("/assets/index.js?x=1", None, "[::1]"),
        ("/", "http://127.0.0.1:8080", "127.0.0.1:8080"),
        ("/", "http://localhost:8080", "localhost:8080"),
        ("/", "https://[::1]:8080", "[::1]:8080"),
    ],
)
def test_allowed(path, origin, host):
    assert allowed(path, origin, host, local=True)
    assert allowed(path, origin, host, local=False)


@pytest.mark.parametrize(
    "host", ["", "elsewhere.example:8080", "127.0.0.1.elsewhere.example", "localhost.example", "10.0.0.7"]
)
@pytest.mark.parametrize("scheme", [None, "http"])
def test_names_that_may_mean_this_machine(host, scheme):
    """DNS rebinding: to the browser a page of that name comes from this server."""
    origin = scheme and f"{scheme}://{host}"
    assert not allowed("/", origin, host, local=True)
    assert allowed("/", origin, host, local=False)  # where others may look on, they may do so by the machine's name


@pytest.mark.parametrize(
    ("at", "host", "status"),
    [
        ("127.0.0.1", "elsewhere.example", 403),
        ("localhost", "elsewhere.example", 403),
        ("127.0.0.1", "localhost", 200),
        ("0.0.0.0", "elsewhere.example", 200),
    ],
)
def test_where_the_server_listens_says_what_it_may_be_called(at, host, status):
    assert asked(at, "/", Host=host).status_code == status


def asked(at: str, path: str, token: str | None = None, **headers: str) -> SimpleNamespace:
    """What a guarded server answers."""

    def served(process_request):
        connection = SimpleNamespace(respond=lambda status, text: SimpleNamespace(status_code=status, headers={}))
        return process_request(connection, SimpleNamespace(path=path, headers=headers))

    page = SimpleNamespace(status_code=200, headers={})
    serve = patch.object(websockets_server, "serve", lambda *, process_request: served(process_request))
    with serve, guarded(at, token):
        return websockets_server.serve(process_request=lambda *_: page)


def test_who_has_the_token_is_let_in_and_keeps_it():
    first = asked("0.0.0.0", "/?token=secret", "secret", Host="there:8080")
    assert first.status_code == 200
    cookie, *attributes = first.headers["Set-Cookie"].split("; ")
    assert {"HttpOnly", "SameSite=Strict"} <= set(attributes)
    assert asked("0.0.0.0", "/", "secret", Host="there:8080", Cookie=f"other=1; {cookie}").status_code == 200


@pytest.mark.parametrize(
    ("path", "cookies"),
    [
        ("/", ""),
        ("/?token=", ""),
        ("/?token=secre", ""),
        ("/?token=secret2", "ctm_view=guess"),
        ("/?tok=secret", "ctm_view="),
        ("/secret", "other=secret; my_ctm_view=secret"),
        ("/?token=s%C3%A9cret", "ctm_view=s\xe9cret"),
    ],
)
def test_who_has_no_token_is_not(path, cookies):
    assert not admitted(path, cookies, "secret")
    assert asked("0.0.0.0", path, "secret", Host="there:8080", Cookie=cookies).status_code == 403


@pytest.mark.parametrize(
    ("path", "origin", "host"),
    [
        ("/../secret", None, "127.0.0.1:8080"),
        ("/assets/../../secret", None, "127.0.0.1:8080"),
        ("/..", None, "127.0.0.1:8080"),
        ("/..\\secret", None, "127.0.0.1:8080"),
        ("/C:\\secret", None, "127.0.0.1:8080"),
        ("//etc/passwd", None, "127.0.0.1:8080"),
        ("etc/passwd", None, "127.0.0.1:8080"),
        ("http://elsewhere/", None, "127.0.0.1:8080"),
        ("/", "http://elsewhere.example", "127.0.0.1:8080"),
        ("/", "http://127.0.0.1:9090", "127.0.0.1:8080"),
        ("/", "null", "127.0.0.1:8080"),
        ("/", "http://127.0.0.1:8080@elsewhere.example", "127.0.0.1:8080"),
    ],
)
def test_refused(path, origin, host):
    assert not allowed(path, origin, host, local=False)
