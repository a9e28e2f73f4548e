"""The page: viser's canvas and controls, and the painter behind them."""

from __future__ import annotations

import asyncio
import math
import socket
import threading
from collections.abc import Callable, Sequence
from typing import NamedTuple

import viser
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.color.light import MOST_STOPS, factor_of
from ctm_plugin.cpu.products import fast_products
from ctm_plugin.errors import ConfigError, CTMError
from ctm_plugin.runs.load import KINDS
from ctm_plugin.scene.camera_paths import mean_up
from ctm_plugin.view.camera import Camera, pivot
from ctm_plugin.view.guard import guarded
from ctm_plugin.view.live_run import Subject
from ctm_plugin.view.painter import Painter

EVERY = 2.0
"""Seconds between looks for a new checkpoint."""
LABELS = dict(zip(KINDS, ("RGB", "lifted", "latent", "depth"), strict=True))


class Look(NamedTuple):
    """What a client looks at."""

    subject: Subject
    kind: str
    camera: Camera
    factor: float


class Controls(NamedTuple):
    """A client's own controls."""

    subject: viser.GuiDropdownHandle[str] | None
    kind: viser.GuiDropdownHandle[str]
    stops: viser.GuiSliderHandle[float]
    status: viser.GuiTextHandle
    trouble: viser.GuiTextHandle


class Viewer:
    """A web server for one run, or several of the same scene to switch between.

    Args:
        subjects: at least one.
        host, port: where to listen.
        light: where the slider for the light of lifted pictures begins, see :func:`ctm_plugin.color.light.factor_of`.

    Raises:
        ConfigError: nothing can listen there.
        CTMError: the runs' scenes differ.
    """

    def __init__(self, subjects: Sequence[Subject], host: str, port: int, light: str = "auto"):
        check_same_scene(subjects)
        check_free(host, port)
        self.subjects = dict(zip(names(subjects), subjects, strict=True))
        self.scene = subjects[0].scene
        self.stops = math.log2(factor_of(light, max(subject.run.factor for subject in subjects)))
        self.painter = Painter[Look, Float[Tensor, "h w 3"]](self._prepare, self._paint, self._show)
        self._painted: set[Subject] = set()
        self._controls: dict[int, Controls] = {}
        self._closed = threading.Event()
        before = set(threading.enumerate())
        with guarded(host):
            self.server = Unshared(host=host, port=port, label=self.scene.name, verbose=False)
        self._serving = set(threading.enumerate()) - before
        self.server.gui.configure_theme(dark_mode=True, show_logo=False)
        self.server.on_client_connect(self._welcome)
        self.server.on_client_disconnect(lambda client: self._forget(client.client_id))

    def work(self) -> None:
        """Serve until :meth:`close`, painting in this thread."""
        threading.Thread(target=self._watch, daemon=True).start()
        with fast_products(next(iter(self.subjects.values())).run.module.device):
            self.painter.work()

    def close(self) -> None:
        """End :meth:`work`, and the server."""
        self._closed.set()
        self.painter.close()
        self.server.stop()
        for thread in self._serving:  # it prints at its end, which is not to be that of the interpreter
            thread.join()
        self.server._event_loop.run_until_complete(cancel_others())

    def _watch(self) -> None:
        while not self._closed.wait(EVERY):
            self.painter.repaint(lambda look: look.subject.changed())

    def _welcome(self, client: viser.ClientHandle) -> None:
        """A client's controls, and its camera at the first test view."""
        gui, several = client.gui, len(self.subjects) > 1
        subject = gui.add_dropdown("run", tuple(self.subjects)) if several else None
        kind = gui.add_dropdown("picture", tuple(LABELS.values()), LABELS["lifted" if self.stops else "rgb"])
        stops = gui.add_slider(
            "light, stops", -MOST_STOPS, MOST_STOPS, 0.1, round(self.stops, 1), hint="of lifted pictures: 1 doubles it"
        )
        button = gui.add_button("next test view")
        # Plain text: viser's Markdown would run what stands in it, such as a folder's name, in the browser.
        status = gui.add_text("shown", "", disabled=True)
        trouble = gui.add_text("checkpoint", "", disabled=True, visible=False)
        self._controls[client.client_id] = Controls(subject, kind, stops, status, trouble)
        view = 0

        async def ask(_: object) -> None:
            self._ask(client)

        for control in filter(None, (subject, kind, stops)):
            control.on_update(ask)
        client.camera.on_update(ask)

        @button.on_click
        def _(_: object) -> None:
            nonlocal view
            view = (view + 1) % len(self.scene.test)
            self._place(client, view)

        self._place(client, view)
        self._ask(client)

    def _forget(self, client: int) -> None:
        self._controls.pop(client, None)  # first: without controls nothing is asked for
        self.painter.forget(client)

    def _place(self, client: viser.ClientHandle, view: int) -> None:
        """Put a client's camera where a test view's is."""
        test = self.scene.test
        c2w, (_, fy, _, _) = test.c2w[view], test.intrinsics[view].tolist()
        with client.atomic():
            client.camera.up_direction = mean_up(self.scene.train)
            client.camera.position = c2w[:, 3].double().numpy()
            client.camera.look_at = pivot(self.scene, c2w)
            client.camera.fov = 2 * math.atan(test.height / (2 * fy))

    def _ask(self, client: viser.ClientHandle) -> None:
        controls, at = self._controls.get(client.client_id), client.camera
        camera = Camera(tuple(at.wxyz), tuple(at.position), at.fov, at.aspect)
        if controls is not None and camera.usable():
            subject = next(iter(self.subjects)) if controls.subject is None else controls.subject.value
            kind = next(key for key, label in LABELS.items() if label == controls.kind.value)
            factor = 2.0 ** min(max(controls.stops.value, -MOST_STOPS), MOST_STOPS)
            self.painter.ask(client.client_id, Look(self.subjects[subject], kind, camera, factor))

    def _prepare(self, look: Look) -> bool:
        """Take a new checkpoint. The time of a run's first picture tells nothing: GPUs load their code in it."""
        look.subject.refresh()
        known = look.subject in self._painted
        self._painted.add(look.subject)
        return known

    @staticmethod
    def _paint(look: Look, size: int, go_on: Callable[[], bool]) -> Float[Tensor, "h w 3"] | None:
        return look.subject.paint(look.camera, look.kind, size, go_on, look.factor)

    def _show(self, client: int, look: Look, picture: Float[Tensor, "h w 3"], seconds: float) -> None:
        handle, controls = self.server.get_clients().get(client), self._controls.get(client)
        if handle is None or controls is None:  # gone meanwhile, perhaps before it was welcomed
            self._forget(client)
            return
        height, width = picture.shape[:2]
        handle.scene.set_background_image((picture.clamp(0, 1) * 255).round().byte().numpy(), format="png")
        controls.status.value = f"step {look.subject.run.step}, {width}x{height} in {seconds:.2f} s"
        controls.trouble.value, controls.trouble.visible = look.subject.trouble, bool(look.subject.trouble)


class Unshared(viser.ViserServer):
    """A server whose clients cannot have it open a tunnel to the internet."""

    def request_share_url(self, verbose: bool = True) -> None:
        for client in self.get_clients().values():
            client.add_notification("not shared", "this page stays on the machine that serves it")


async def cancel_others() -> None:
    """End what else a loop has to do: viser leaves tasks for clients, and Python complains of them as it exits."""
    tasks = asyncio.all_tasks() - {asyncio.current_task()}
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


def names(subjects: Sequence[Subject]) -> list[str]:
    """How runs are told apart: by their CTM, else by their folders."""
    settings = [subject.run.config["ctm"] for subject in subjects]
    by_ctm = [f"CTM {ctm.get('preset', ctm['name'])}" for ctm in settings]
    by_folder = [str(subject.folder) for subject in subjects]
    return by_ctm if len(set(by_ctm)) == len(by_ctm) else by_folder


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
        raise ConfigError(
            "host, port", f"{host}, {port}", f"an address to listen at ({error}); port=N is another"
        ) from error
