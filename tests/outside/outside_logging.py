"""What another package brings: a logger that writes notes, a callback that counts."""

import json
from dataclasses import dataclass

import lightning as L

from ctm_plugin.loggers.base import RunLogger


class Notes(RunLogger):
    """``RUN/FILE``, a line of JSON for whatever is told."""

    name, version = "notes", 0

    @dataclass(frozen=True)
    class Config:
        file: str = "notes.txt"

    def __init__(self, config, run, step):
        super().__init__()
        self.path, self.began = run / config.file, step

    def note(self, kind, content, step):
        with self.path.open("a") as file:
            file.write(json.dumps([kind, step, self.began, content]) + "\n")

    def log_metrics(self, metrics, step=None):
        self.note("curves", metrics, step)

    def log_hyperparams(self, params, *_):
        self.note("settings", params, None)

    def log_pictures(self, pictures, step):
        self.note("pictures", {name: list(picture.shape) for name, picture in pictures.items()}, step)

    def log_histograms(self, values, step):
        self.note("histograms", {name: values.numel() for name, values in values.items()}, step)


@dataclass(eq=False)
class Count(L.Callback):
    """Counts batches, over interruptions too, and logs the count as any Lightning callback may."""

    by: int = 1
    batches: int = 0

    def on_train_batch_end(self, trainer, pl_module, *_):
        self.batches += self.by
        pl_module.log("theirs/batches", float(self.batches))

    def state_dict(self):
        return {"batches": self.batches}

    def load_state_dict(self, state):
        self.batches = state["batches"]
