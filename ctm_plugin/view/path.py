"""A camera path through key frames: made, tried, saved and loaded."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import viser

from ctm_plugin.data.readers.key_frames import parse_key_frames
from ctm_plugin.errors import DataError
from ctm_plugin.scene.key_frames import KeyFrames
from ctm_plugin.view.camera import Camera

RATE = 10
"""Pictures a second of a path that is tried."""
DRAWN = 20
"""Points of the drawn path to each key."""
COLOUR = (80, 220, 120)


class PathPanel:
    """Controls of the path that ``ctm render RUN path=FILE`` films.

    Args:
        client: whose page.
        name: of the scene, the saved file's.
        size: of a drawn camera, in scene units.
        aim: puts the client's camera somewhere.
    """

    def __init__(self, client: viser.ClientHandle, name: str, size: float, aim: Callable[[Camera], None]):
        self._client, self._size, self._aim = client, size, aim
        self._keys: list[Camera] = []
        self._marks: list[viser.SceneNodeHandle] = []
        self._playing = False
        gui = client.gui
        with gui.add_folder("camera path", expand_by_default=False):
            add = gui.add_button("add key frame")
            self._count = gui.add_text("key frames", "0", disabled=True)
            edit = gui.add_button_group("take away", ("last", "all"))
            self._closed = gui.add_checkbox("closed", False, hint="goes on from the last key frame to the first")
            self._seconds = gui.add_number("seconds", 5.0, min=1.0, max=60.0, step=0.5, hint="of trying it")
            play = gui.add_button_group("try it", ("play", "stop"))
            save = gui.add_button("save the path", hint="ctm render RUN path=FILE films it")
            load = gui.add_upload_button("load a path", mime_type="application/json")

        @add.on_click
        async def _(_: object) -> None:
            at = client.camera
            camera = Camera(tuple(at.wxyz), tuple(at.position), at.fov, at.aspect)
            if camera.usable():
                self.set([*self._keys, camera])

        @edit.on_click
        async def _(_: object) -> None:
            self.set(self._keys[:-1] if edit.value == "last" else [])

        @self._closed.on_update
        async def _(_: object) -> None:
            self.set(self._keys)

        @play.on_click
        async def _(_: object) -> None:
            was, self._playing = self._playing, play.value == "play" and bool(self._keys)
            if self._playing and not was:
                await self._play()

        @save.on_click
        async def _(_: object) -> None:
            if self._keys:
                content = json.dumps(self.key_frames().content(), indent=2).encode()
                client.send_file_download(f"{name}.json", content, save_immediately=True)

        @load.on_upload
        async def _(_: object) -> None:
            try:
                self.load(load.value.content, load.value.name)
            except DataError as error:
                client.add_notification("no camera path", str(error), color="red")

    def key_frames(self) -> KeyFrames:
        """What was made, at least one."""
        poses = np.stack([camera.c2w.double().numpy() for camera in self._keys])
        return KeyFrames(poses, np.array([camera.fov for camera in self._keys]), bool(self._closed.value))

    def load(self, content: bytes, name: str) -> None:
        """Take a file's key frames in place of those that are there.

        Raises:
            DataError: it is none.
        """
        keys = parse_key_frames(content, Path(name))
        self._closed.value = keys.closed
        self.set([Camera.of(c2w, fov, 1.0) for c2w, fov in zip(keys.c2w, keys.fov.tolist(), strict=True)])

    def set(self, keys: list[Camera]) -> None:
        """Take and draw key frames."""
        self._keys, self._count.value = keys, str(len(keys))
        for mark in self._marks:
            mark.remove()
        add, how = self._client.scene, {"thickness": 2.0, "thickness_units": "screen"}
        self._marks = [
            add.add_camera_frustum(
                f"/marks/path/{number}",
                key.fov,
                key.aspect,
                scale=self._size,
                color=COLOUR,
                wxyz=key.wxyz,
                position=key.position,
                **how,
            )
            for number, key in enumerate(keys)
        ]
        if len(keys) > 1:
            c2w, _ = self.key_frames().path(DRAWN * len(keys))
            lines = np.array(list(pairwise(c2w[:, :, 3].numpy())))
            self._marks.append(add.add_line_segments("/marks/path/line", lines, COLOUR, **how))

    async def _play(self) -> None:
        c2w, fov = self.key_frames().path(max(2, round(RATE * self._seconds.value)))
        for pose, angle in zip(c2w.double().numpy(), fov.tolist(), strict=True):
            if not self._playing:
                return
            self._aim(Camera.of(pose, angle, 1.0))
            await asyncio.sleep(1 / RATE)
        self._playing = False
