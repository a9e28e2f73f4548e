"""A film of an alignment: where the patches are and the fused picture, while both are learned (paper, Figure 6)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lightning as L
from PIL import Image

from ctm_plugin.backbones.barf2d import BARF2D
from ctm_plugin.data.images import read_image, to_8_bits
from ctm_plugin.files import replacing
from ctm_plugin.pictures import write_png
from ctm_plugin.planar import film_frame
from ctm_plugin.snapshot import stride

FRAMES = 20
FRAME_MS = 200
FAST = Image.Quantize.FASTOCTREE


class Film(L.Callback):
    """Write ``folder/STEP.png`` about 20 times in a training of :class:`BARF2D`, and ``film.gif`` of them at the end.

    Frames lie on disk as they are made, so that a resumed run ends with a whole film.
    """

    def __init__(self, folder: Path):
        self.folder = folder

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if trainer.global_step == 0:
            self._frame(trainer, pl_module)

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        if trainer.global_step % max(1, trainer.max_steps // FRAMES) == 0:
            self._frame(trainer, pl_module)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if not trainer.is_global_zero or trainer.global_step < trainer.max_steps:
            return
        frames = [to_8_bits(read_image(path)).numpy() for path in sorted(self.folder.glob("*.png"))]
        # A run's folder may hold others'. Of Pillow's ways to 256 colours the fastest, a tenth of the default's time.
        shown = [Image.fromarray(frame).quantize(method=FAST) for frame in frames if frame.shape == frames[-1].shape]
        if shown:
            with replacing(self.folder.with_suffix(".gif")) as path:
                shown[0].save(path, "GIF", save_all=True, append_images=shown[1:], duration=FRAME_MS, loop=0)

    def _frame(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if not trainer.is_global_zero or not isinstance(pl_module, BARF2D):
            return
        every = max(2, stride(pl_module, pl_module.scene.width, pl_module.scene.height))
        write_png(self.folder / f"{trainer.global_step:06d}.png", film_frame(pl_module, every))
