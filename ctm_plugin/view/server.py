"""The viewer's web server: a page for each browser client, and one painter for all."""

from __future__ import annotations

import io
import secrets
import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from functools import partial
from hmac import compare_digest
from http.cookies import SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

import viser
from jaxtyping import Float
from torch import Tensor
from websockets.asyncio import server

from ctm_plugin.color.light import chosen_light
from ctm_plugin.cpu.products import fast_products
from ctm_plugin.errors import ConfigError, CTMError
from ctm_plugin.view.page import Page
from ctm_plugin.view.painter import MIN_SIDE, Look, Painter, Renderings, Viewpoint
from ctm_plugin.view.settings import ViewConfig
from ctm_plugin.view.sources import Subject, photographs

POLL_S = 2.0
"""Most seconds from one check for a new checkpoint to the next."""
LOCAL_HOSTS = ("127.0.0.1", "localhost", "::1")
"""Hosts that no other machine reaches."""
CONTENT_POLICY = (
    "default-src 'self' data: blob:; "
    "script-src 'self' 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob:; "
    "style-src 'self' 'unsafe-inline'"
)
"""Content-Security-Policy: the browser loads nothing from other hosts than the page's."""
COOKIE = "ctm_view"


class Viewer:
    """A web server for one run, or several of the same scene.

    Args:
        subjects: the runs to serve, at least one.
        settings: where to listen, and in which light to begin.

    Attributes:
        address: URL of the page, with a token where other machines can reach it.

    Raises:
        ConfigError: nothing can listen there.
        CTMError: the runs' scenes differ.
    """

    def __init__(self, subjects: Sequence[Subject], settings: ViewConfig):
        check_same_scene(subjects)
        host, port = settings.host, settings.port
        check_free(host, port)
        self.subjects = dict(zip(names(subjects), subjects, strict=True))
        self.first = subjects[0]
        self.views = photographs(self.first.scene, self.first.run.module.constant_background().cpu())
        self.light = chosen_light(
            settings, max((subject.run.light for subject in subjects), key=lambda light: light.gain)
        )
        self.renderings = Renderings()
        self.painter = Painter(self.renderings.paint, self._show)
        self._pages: dict[int, Page] = {}
        token = None if host in LOCAL_HOSTS else secrets.token_urlsafe(16)
        self.address = page_address(host, port, token)
        with guarded(token), redirect_stdout(io.StringIO()):  # viser tells the address without the token
            self.server = viser.ViserServer(host=host, port=port, label=self.first.scene.name, verbose=False)
        self.server.request_share_url = lambda: None  # clients cannot have it open a tunnel to the internet
        self.server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self.server.gui.main_panel.dock_right()
        self.server.on_client_connect(self._welcome)
        self.server.on_client_disconnect(self._forget)

    def work(self) -> None:
        """Serve until :meth:`close`, painting in this thread."""
        with fast_products(self.first.run.module.device):
            for subject in self.subjects.values():  # compiles loops and loads a GPU's code: no picture's time
                subject.render(Viewpoint(self.views[0].camera), MIN_SIDE, MIN_SIDE, lambda: None)
            while not self.painter.closed:
                if self._pages and any(subject.refresh() for subject in self.subjects.values()):
                    self.renderings.clear()
                    self.painter.repaint()
                self.painter.step(POLL_S)

    def close(self) -> None:
        """End :meth:`work`, and the server."""
        self.painter.close()
        self.server.stop()

    # Coroutines, so that viser calls them in the order of events.
    async def _welcome(self, client: viser.ClientHandle) -> None:
        ask = partial(self.painter.ask, client.client_id)
        page = Page(client, self.subjects, self.views, self.light, ask)
        self._pages[client.client_id] = page
        page.ask()

    async def _forget(self, client: viser.ClientHandle) -> None:
        self._pages.pop(client.client_id, None)
        self.painter.forget(client.client_id)

    def _show(self, client: int, look: Look, picture: Float[Tensor, "h w 3"], seconds: float) -> None:
        if page := self._pages.get(client):
            page.show(look, picture, seconds)


def names(subjects: Sequence[Subject]) -> list[str]:
    """Names that distinguish runs: by their CTM, else by their folders."""
    settings = [subject.run.config["ctm"] for subject in subjects]
    by_ctm = [f"CTM {ctm.get('preset', ctm['name'])}" for ctm in settings]
    return by_ctm if len(set(by_ctm)) == len(by_ctm) else [str(subject.folder) for subject in subjects]


def check_same_scene(subjects: Sequence[Subject]) -> None:
    """Refuse runs that cannot be compared from one camera.

    Raises:
        CTMError: test cameras differ.
    """
    first = subjects[0]
    for other in subjects[1:]:
        ours, theirs = first.scene.test.c2w, other.scene.test.c2w
        if first.scene.name != other.scene.name or not ours.equal(theirs):
            raise CTMError(
                f"{other.folder}: found a run of {other.scene.name} with other test cameras, "
                f"expected those of {first.scene.name} as in {first.folder}"
            )


def check_free(host: str, port: int) -> None:
    """Refuse an address that nothing can listen at; viser would wait for ever, or take another.

    Raises:
        ConfigError: the address is in use or cannot be used.
    """
    try:
        socket.create_server((host, port)).close()
    except (OSError, OverflowError) as error:
        expected = f"an address to listen at ({error}); port=N is another"
        raise ConfigError("host, port", f"{host}, {port}", expected) from error


def page_address(host: str, port: int, token: str | None) -> str:
    """URL of the page, with this machine's name where the server listens at all addresses."""
    name = socket.gethostname() if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
    return f"http://{name}:{port}/" + (f"?token={token}" if token else "")


def admitted(path: str, headers: Mapping[str, str], token: str | None) -> bool:
    """Whether to answer a request: it comes from the server's own page or from none, and it has the token.

    Without a token only this machine's names are accepted as host: another name may be another site's.
    """
    host, origin = headers.get("Host", ""), headers.get("Origin")
    if origin is not None and urlsplit(origin).netloc != host:
        return False
    if token is None:
        return urlsplit(f"//{host}").hostname in LOCAL_HOSTS
    cookie = SimpleCookie(headers.get("Cookie", "")).get(COOKIE)
    given = [*parse_qs(urlsplit(path).query).get("token", []), cookie.value if cookie else ""]
    return any(compare_digest(each.encode(), token.encode()) for each in given)


@contextmanager
def guarded(token: str | None) -> Iterator[None]:
    """Context in which a server of viser answers only :func:`admitted` requests, and sends ``CONTENT_POLICY``.

    By itself viser lets pages of other sites connect, also by DNS rebinding, and asks other machines for no token. Its
    page loads a script for statistics from another host.

    Args:
        token: secret that the first request must have, as ``/?token=TOKEN``; the browser then keeps it as a cookie.
            ``None``: the server listens only to this machine.
    """
    serve = server.serve

    def with_guard(*args: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            if not admitted(request.path, request.headers, token):
                return connection.respond(403, "this page wants the whole address that `ctm view` printed\n")
            response = process_request(connection, request)
            if response is not None:
                response.headers["Content-Security-Policy"] = CONTENT_POLICY
                if token is not None:
                    response.headers["Set-Cookie"] = f"{COOKIE}={token}; Path=/; HttpOnly; SameSite=Strict"
                    response.headers["Referrer-Policy"] = "no-referrer"
            return response

        return serve(*args, process_request=answer, **options)

    server.serve = with_guard
    try:
        yield
    finally:
        server.serve = serve
