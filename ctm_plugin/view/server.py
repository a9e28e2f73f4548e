"""The viewer's web server: a page for each browser client, and one painter for all."""

from __future__ import annotations

import io
import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from functools import partial
from typing import Any
from urllib.parse import urlsplit

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
HOST = "127.0.0.1"
"""Address of the page, which no other machine reaches."""
CONTENT_POLICY = (
    "default-src 'self' data: blob:; "
    "script-src 'self' 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob:; "
    "style-src 'self' 'unsafe-inline'"
)
"""Content-Security-Policy: the browser loads nothing from other hosts than the page's."""


class Viewer:
    """A web server for one run, or several of the same scene.

    Args:
        subjects: the runs to serve, at least one.
        settings: the port, and in which light to begin.

    Attributes:
        address: URL of the page.

    Raises:
        ConfigError: nothing can listen there.
        CTMError: the runs' scenes differ.
    """

    def __init__(self, subjects: Sequence[Subject], settings: ViewConfig):
        check_same_scene(subjects)
        check_free(settings.port)
        self.subjects = dict(zip(names(subjects), subjects, strict=True))
        self.first = subjects[0]
        self.views = photographs(self.first.scene, self.first.run.module.constant_background().cpu())
        self.light = chosen_light(
            settings, max((subject.run.light for subject in subjects), key=lambda light: light.gain)
        )
        self.renderings = Renderings()
        self.painter = Painter(self.renderings.paint, self._show)
        self._pages: dict[int, Page] = {}
        self.address = f"http://{HOST}:{settings.port}/"
        with guarded(), redirect_stdout(io.StringIO()):  # the verb prints the address
            self.server = viser.ViserServer(host=HOST, port=settings.port, label=self.first.scene.name, verbose=False)
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
        if page := self._pages.pop(client.client_id, None):
            page.leave()
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


def check_free(port: int) -> None:
    """Refuse a port that nothing can listen at; viser would take another.

    Raises:
        ConfigError: the port is in use or cannot be used.
    """
    try:
        socket.create_server((HOST, port)).close()
    except OSError as error:
        raise ConfigError("port", port, f"another port ({error})") from error


def admitted(headers: Mapping[str, str]) -> bool:
    """Whether to answer a request: it comes from the server's own page or from none, by this machine's own name.

    Another name may be another site's.
    """
    host, origin = headers.get("Host", ""), headers.get("Origin")
    if origin is not None and urlsplit(origin).netloc != host:
        return False
    return urlsplit(f"//{host}").hostname in (HOST, "localhost")


@contextmanager
def guarded() -> Iterator[None]:
    """Context in which a server of viser answers only :func:`admitted` requests, and sends ``CONTENT_POLICY``.

    By itself viser lets pages of other sites connect, also by DNS rebinding. Its page loads a script for statistics
    from another host.
    """
    serve = server.serve

    def with_guard(*args: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            if not admitted(request.headers):
                return connection.respond(403, "this page wants the address that `ctm view` printed\n")
            response = process_request(connection, request)
            if response is not None:
                response.headers["Content-Security-Policy"] = CONTENT_POLICY
            return response

        return serve(*args, process_request=answer, **options)

    server.serve = with_guard
    try:
        yield
    finally:
        server.serve = serve
