"""How fine pictures become, what is shown now, and saving it."""

from __future__ import annotations

from collections.abc import Callable

import imageio.v3 as iio
import numpy as np
import viser

from ctm_plugin.view.command import MOST_SECONDS, SIZES
from ctm_plugin.view.painter import Limit


class QualityPanel:
    """Controls of size and time, a button that saves the picture, and lines of text about it.

    Args:
        client: whose page.
        limit: where the controls begin.
        changed: called when finer or coarser pictures are wanted.
        name: what a saved picture is called, without its ending.
    """

    def __init__(self, client: viser.ClientHandle, limit: Limit, changed: Callable, name: Callable[[], str]):
        gui, self._picture = client.gui, None
        # Plain text: viser's Markdown would run what stands in it, such as a folder's name, in the browser.
        self._status = gui.add_text("shown", "", disabled=True)
        self._trouble = gui.add_text("checkpoint", "", disabled=True, visible=False)
        save = gui.add_button("save the picture")
        with gui.add_folder("quality", expand_by_default=False):
            self._size = gui.add_number("longer side", limit.finest, min=SIZES[0], max=SIZES[1], step=1, hint="pixels")
            self._seconds = gui.add_number("seconds", limit.seconds, min=0.1, max=float(MOST_SECONDS), step=0.1)
        for control in (self._size, self._seconds):
            control.on_update(changed)

        @save.on_click
        def _(_: object) -> None:
            if self._picture is not None:
                content = iio.imwrite("<bytes>", self._picture, extension=".png")
                client.send_file_download(f"{name()}.png", content, save_immediately=True)

    @property
    def limit(self) -> Limit:
        size, seconds = self._size.value, self._seconds.value
        return Limit(min(max(int(size), SIZES[0]), SIZES[1]), min(max(float(seconds), 0.1), MOST_SECONDS))

    def show(self, picture: np.ndarray, status: str, trouble: str) -> None:
        """Tell of the picture, bytes ``[H, W, 3]``, that is shown now."""
        self._picture = picture
        self._status.value = status
        self._trouble.value, self._trouble.visible = trouble, bool(trouble)
