"""Panel of the viewer to make, preview and save a camera path through key frames."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable, Sequence

import numpy as np
import viser

from ctm_plugin.scene.camera_paths import KeyFrames
from ctm_plugin.view.camera import BrowserCamera

PREVIEW_FPS = 10
"""Pictures a second of a previewed path."""
PATH_STYLE = {"color": (80, 220, 120), "thickness": 2.0, "thickness_units": "screen"}
"""Colour and width of the path's line."""


def called(do: Callable[[], Awaitable[None] | None]) -> Callable[[object], Awaitable[None]]:
    """Wrap ``do`` as a coroutine for viser, which runs coroutines in the order of events, and others in threads."""

    async def callback(_: object) -> None:
        if (done := do()) is not None:
            await done

    return callback


def camera_of(client: viser.ClientHandle) -> BrowserCamera | None:
    """The present camera of a browser client; ``None`` before the client has sent one."""
    at = client.camera
    camera = BrowserCamera(tuple(at.wxyz), tuple(at.position), at.fov, at.aspect)
    return camera if camera.usable() else None


class PathPanel:
    """Controls of the path that ``ctm render RUN path=FILE`` films.

    Args:
        client: viser's handle of the browser client.
        name: name of the scene, used for the saved file.
        size: size of a drawn camera in scene units.
        aim: function that moves the client's camera.
        lit: controls of light in stops, contrast and saturation, which are saved with the path.
    """

    def __init__(
        self, client: viser.ClientHandle, name: str, size: float, aim: Callable[[BrowserCamera], None],
        lit: Sequence[viser.GuiSliderHandle[float]],
    ):  # fmt: skip
        self._client, self._name, self._size, self._aim, self._lit = client, name, size, aim, lit
        self._keys: list[BrowserCamera] = []
        self._marks: list[viser.SceneNodeHandle] = []
        self._playing = False
        gui = client.gui
        with gui.add_folder("camera path", expand_by_default=False):
            gui.add_button("add key frame").on_click(called(self._add))
            self._count = gui.add_text("key frames", "0", disabled=True)
            edit = gui.add_button_group("take away", ("last", "all"))
            self._closed = gui.add_checkbox("closed", False, hint="goes on from the last key frame to the first")
            self._seconds = gui.add_number("seconds", 5.0, min=1.0, max=60.0, step=0.5, hint="of trying it")
            play = gui.add_button_group("try it", ("play", "stop"))
            gui.add_button("save the path", hint="ctm render RUN path=FILE films it").on_click(called(self._save))
        edit.on_click(called(lambda: self.set(self._keys[:-1] if edit.value == "last" else [])))
        self._closed.on_update(called(lambda: self.set(self._keys)))
        play.on_click(called(lambda: self._play(play.value == "play")))

    def key_frames(self) -> KeyFrames:
        """The path's key frames, at least one."""
        poses = np.stack([camera.c2w.double().numpy() for camera in self._keys])
        lit = tuple(float(control.value) for control in self._lit)
        return KeyFrames(poses, np.array([camera.fov for camera in self._keys]), bool(self._closed.value), lit)

    def set(self, keys: list[BrowserCamera]) -> None:
        """Replace the path's key frames, and draw them."""
        self._keys, self._count.value, add = keys, str(len(keys)), self._client.scene
        for mark in self._marks:
            mark.remove()
        self._marks = [
            add.add_camera_frustum(
                f"/marks/path/{number}", key.fov, key.aspect, scale=self._size, wxyz=key.wxyz, position=key.position,
                **PATH_STYLE,
            )
            for number, key in enumerate(keys)
        ]  # fmt: skip
        if len(keys) > 1:
            eyes, closed = np.array([key.position for key in keys]), bool(self._closed.value)
            line = add.add_spline_catmull_rom("/marks/path/line", eyes, "catmullrom", closed=closed, **PATH_STYLE)
            self._marks.append(line)

    def _add(self) -> None:
        if (camera := camera_of(self._client)) is not None:
            self.set([*self._keys, camera])

    def _save(self) -> None:
        if self._keys:
            content = json.dumps(self.key_frames().content(), indent=2).encode()
            self._client.send_file_download(f"{self._name}.json", content, save_immediately=True)

    async def _play(self, play: bool) -> None:
        was, self._playing = self._playing, play and bool(self._keys)
        if was or not self._playing:
            return
        c2w, fov = self.key_frames().path(max(2, round(PREVIEW_FPS * self._seconds.value)))
        for pose, angle in zip(c2w.double().numpy(), fov.tolist(), strict=True):
            if not self._playing:
                return
            self._aim(BrowserCamera.of(pose, angle))
            await asyncio.sleep(1 / PREVIEW_FPS)
        self._playing = False
