"""The configuration inside the checkpoint."""

from __future__ import annotations

from typing import Any

import lightning as L

from ctm_plugin.settings.build import Config


class RunInfo(L.Callback):
    """Put the run's configuration, plain containers, into its checkpoints, so that a stranger's can be told apart."""

    def __init__(self, config: Config):
        self.config = dict(config)

    def on_save_checkpoint(self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: dict[str, Any]) -> None:
        checkpoint["config"] = self.config
