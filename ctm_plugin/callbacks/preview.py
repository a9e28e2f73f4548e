"""An early picture of a training, for people who wait."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lightning as L

from ctm_plugin.backbones.posed import PosedBackbone
from ctm_plugin.backbones.untouched import untouched
from ctm_plugin.show.bars import say
from ctm_plugin.show.pictures import beside, write_png

READY_AT = 0.1
"""Share of the schedule after which the first picture is worth a look."""
PREVIEW = "preview.png"
"""Name of the preview's file in the run's folder."""


class Preview(L.Callback):
    """Write ``RUN/preview.png`` after a tenth of the schedule: a lit test view and its photograph in that light."""

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: PosedBackbone, *_: Any) -> None:
        path = Path(trainer.default_root_dir, PREVIEW)
        if trainer.is_global_zero and pl_module.scheduled >= READY_AT * pl_module.schedule_steps and not path.exists():
            light, index = pl_module.light, pl_module.snapshots[0]
            photo = pl_module.target(index)
            with untouched(pl_module):
                rendered = pl_module.render_view(pl_module.scene.test, index)["rgb"].float().cpu()
            both = [pl_module.scene.test.own(index, each) for each in (rendered, photo) if each is not None]
            write_png(path, beside(*map(light.apply, both)))
            say(f"preview: {path}")
