"""A backbone small enough to be replayed by hand, and the Trainer for it."""

from dataclasses import dataclass, field

import lightning as L
import torch
from torch import Tensor, nn
from torch.optim import Adam

from ctm_plugin.backbones.base import Backbone, Batch, Rendering
from ctm_plugin.color.ctm import CTM
from ctm_plugin.color.settings import CTMConfig, TransformTraining
from ctm_plugin.color.transform import ColorTransform
from ctm_plugin.draws import seeded

LR = 1e-2


@dataclass
class ToyBatch(Batch):
    x: Tensor = field(kw_only=True)


class Toy(Backbone):
    """One linear layer from eight random numbers a pixel to its latent."""

    batch_rays = 8

    def __init__(self, steps: int = 6, transform: ColorTransform | None = None, seed: int = 0):
        super().__init__(transform, seed=seed)
        self.total_steps = steps
        with seeded(seed):
            self.layer = nn.Linear(8, self.channels)

    def draw(self, draws):
        rows = self.batch_rays // draws.world
        return ToyBatch(draws.uniform(rows, 3), x=draws.uniform(rows, 8))

    def scene_colors(self, draws, count):
        return draws.uniform(count, 3)

    def predict(self, batch, draws):
        return Rendering((self.layer(batch.x).float().sigmoid(),))

    def field_optimizers(self):
        return {"field": Adam(self.layer.parameters(), LR)}

    def field_schedule(self):
        return lambda step: 0.9**step


class Clock:
    """In the place of the module ``time``: goes on by ``tick`` seconds each time it is read."""

    def __init__(self, tick: float = 0.0, now: float = 0.0):
        self.tick, self.now = tick, now

    def perf_counter(self) -> float:
        self.now += self.tick
        return self.now


def small_ctm(seed: int = 1, learning: TransformTraining | None = None, **config) -> CTM:
    with seeded(seed):
        ctm = CTM(CTMConfig(width=8, P=2, **config))
    ctm.learning = learning or ctm.learning
    return ctm


def trainer(steps: int, *callbacks: L.Callback, **settings) -> L.Trainer:
    quiet = dict.fromkeys(("logger", "enable_checkpointing", "enable_progress_bar", "enable_model_summary"), False)
    quiet |= {"limit_val_batches": 0}
    return L.Trainer(accelerator="cpu", max_steps=steps, callbacks=list(callbacks), **quiet | settings)


def same(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    """Whether two state dicts are equal bit for bit."""
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def copied(module: nn.Module) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in module.state_dict().items()}
