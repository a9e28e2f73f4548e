"""A film of a training, for backbones that draw its frames: BARF-2D's alignment as it is learned (paper, Figure 6)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning as L
from PIL import Image

from ctm_plugin.backbones.base import Backbone
from ctm_plugin.callbacks.settings import FilmConfig
from ctm_plugin.data.readers.images import read_image, to_8_bits
from ctm_plugin.files import replacing
from ctm_plugin.show.pictures import write_png

FRAME_MS = 200
"""Milliseconds for which a frame of the film is shown."""
PALETTE = Image.Quantize.FASTOCTREE
"""Pillow's method of choosing a palette."""


@dataclass(eq=False)
class Film(FilmConfig, L.Callback):
    """Write :meth:`Backbone.film` as ``RUN/film/STEP.png`` now and then, and ``RUN/film.gif`` of them at the end.

    Frames lie on disk as they are made, so that a resumed run ends with a whole film.
    """

    def on_train_start(self, trainer: L.Trainer, pl_module: Backbone) -> None:
        if trainer.global_step == 0:
            self._frame(trainer, pl_module)

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: Backbone, *_: Any) -> None:
        if trainer.global_step % max(1, trainer.max_steps // self.frames) == 0:
            self._frame(trainer, pl_module)

    def on_train_end(self, trainer: L.Trainer, pl_module: Backbone) -> None:
        if not trainer.is_global_zero or trainer.global_step < trainer.max_steps:
            return
        folder = Path(trainer.default_root_dir, "film")
        frames = [to_8_bits(read_image(path)).numpy() for path in sorted(folder.glob("*.png"))]
        # A run's folder may hold others'. Of Pillow's ways to 256 colours the fastest, a tenth of the default's time.
        shown = [Image.fromarray(frame).quantize(method=PALETTE) for frame in frames if frame.shape == frames[-1].shape]
        if shown:
            with replacing(folder.with_suffix(".gif")) as path:
                shown[0].save(path, "GIF", save_all=True, append_images=shown[1:], duration=FRAME_MS, loop=0)

    def _frame(self, trainer: L.Trainer, pl_module: Backbone) -> None:
        if trainer.is_global_zero and (picture := pl_module.film()) is not None:
            write_png(Path(trainer.default_root_dir, "film", f"{trainer.global_step:06d}.png"), picture)
