"""The server: the page of each client, and the painter behind all of them."""

from __future__ import annotations

import io
import math
import secrets
import socket
import threading
from collections.abc import Sequence
from contextlib import redirect_stdout

import viser
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.color.settings import factor_of
from ctm_plugin.cpu.products import fast_products
from ctm_plugin.errors import ConfigError, CTMError
from ctm_plugin.view.camera import view_camera
from ctm_plugin.view.guard import guarded, is_local
from ctm_plugin.view.live_run import Subject
from ctm_plugin.view.look import Look, Renderings, Shot
from ctm_plugin.view.page import Page
from ctm_plugin.view.painter import COARSEST, Limit, Painter
from ctm_plugin.view.photograph import photographs
from ctm_plugin.view.settings import ViewConfig

EVERY = 2.0
"""Seconds between looks for a new checkpoint."""


class Viewer:
    """A web server for one run, or several of the same scene.

    Args:
        subjects: at least one.
        settings: where to listen, and how to look.

    Attributes:
        address: of the page, with its token where other machines reach it.

    Raises:
        ConfigError: nothing can listen there.
        CTMError: the runs' scenes differ.
    """

    def __init__(self, subjects: Sequence[Subject], settings: ViewConfig):
        check_same_scene(subjects)
        host, port = settings.host, settings.port
        check_free(host, port)
        self.subjects = dict(zip(names(subjects), subjects, strict=True))
        first = subjects[0]
        self.views = photographs(first.scene, first.run.module.constant_background().cpu())
        self.stops = math.log2(factor_of(settings.light, max(subject.run.factor for subject in subjects)))
        self.settings = settings
        self.painter = Painter(Renderings().paint, self._show)
        self._pages: dict[int, Page] = {}
        self._closed = threading.Event()
        token = None if is_local(host) else secrets.token_urlsafe(16)
        self.address = page_address(host, port, token)
        before = set(threading.enumerate())
        with guarded(token), redirect_stdout(io.StringIO()):  # viser tells the address without the token
            self.server = Unshared(host=host, port=port, label=first.scene.name, verbose=False)
        self._serving = set(threading.enumerate()) - before
        self.server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self.server.gui.main_panel.dock_right()
        self.server.on_client_connect(self._welcome)
        self.server.on_client_disconnect(lambda client: self._forget(client.client_id))

    def work(self) -> None:
        """Serve until :meth:`close`, painting in this thread."""
        threading.Thread(target=self._watch, daemon=True).start()
        with fast_products(next(iter(self.subjects.values())).run.module.device):
            for subject in self.subjects.values():  # compiles loops and loads a GPU's code: no picture's time
                subject.render(Shot(view_camera(subject.scene.test, 0)), COARSEST, COARSEST, lambda: True)
            self.painter.work()

    def close(self) -> None:
        """End :meth:`work`, and the server."""
        self._closed.set()
        self.painter.close()
        self.server.stop()
        for thread in self._serving:  # it prints at its end, which is not to be that of the interpreter
            thread.join()

    def _watch(self) -> None:
        while not self._closed.wait(EVERY):
            self.painter.repaint(lambda look: any(source.changed() for source in look.sources))

    def _welcome(self, client: viser.ClientHandle) -> None:
        number = client.client_id

        def ask(look: Look, limit: Limit) -> None:
            if number in self._pages:
                self.painter.ask(number, look, limit)

        self._pages[number] = page = Page(client, self.subjects, self.views, self.stops, self.settings, ask)
        page.ask()

    def _forget(self, client: int) -> None:
        self._pages.pop(client, None)  # first: without a page nothing is asked for
        self.painter.forget(client)

    def _show(self, client: int, look: Look, picture: Float[Tensor, "h w 3"], seconds: float) -> None:
        page = self._pages.get(client)
        if page is None or client not in self.server.get_clients():  # gone meanwhile, perhaps before it was welcomed
            self._forget(client)
            return
        page.show(look, picture, seconds)


class Unshared(viser.ViserServer):
    """A server whose clients cannot have it open a tunnel to the internet."""

    def request_share_url(self, verbose: bool = True) -> None:
        for client in self.get_clients().values():
            client.add_notification("not shared", "this page stays on the machine that serves it")


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
        ours, theirs = first.scene.test, other.scene.test
        if first.scene.name != other.scene.name or ours.c2w.shape != theirs.c2w.shape or (ours.c2w != theirs.c2w).any():
            raise CTMError(
                f"{other.folder}: found a run of {other.scene.name} with other test cameras, "
                f"expected those of {first.scene.name} as in {first.folder}"
            )


def check_free(host: str, port: int) -> None:
    """Refuse an address that nothing can listen at; viser would wait for ever, or take another.

    Raises:
        ConfigError: so it is.
    """
    try:
        socket.create_server((host, port)).close()
    except (OSError, OverflowError) as error:
        expected = f"an address to listen at ({error}); port=N is another"
        raise ConfigError("host, port", f"{host}, {port}", expected) from error


def page_address(host: str, port: int, token: str | None) -> str:
    """What to type into a browser: this machine's name where it listens at all of its addresses."""
    name = socket.gethostname() if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
    return f"http://{name}:{port}/" + (f"?token={token}" if token else "")
