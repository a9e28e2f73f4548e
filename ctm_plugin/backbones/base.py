"""What every backbone is: a LightningModule that renders latents and is trained through a colour transform."""

from __future__ import annotations

import gc
import math
from collections.abc import Callable, Hashable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import lightning as L
import torch
from jaxtyping import Float
from lightning.pytorch.strategies import DDPStrategy
from torch import Tensor
from torch.optim import Optimizer
from torch.profiler import record_function

from ctm_plugin.appearance.exposure import Exposure
from ctm_plugin.color.light import AS_IS, Light
from ctm_plugin.color.photometric import Photometric
from ctm_plugin.color.spaces.rgb import Space as RGB
from ctm_plugin.color.transform import ColorTransform, Uniform
from ctm_plugin.draws import Draws
from ctm_plugin.gpu.replay import Replay, Step
from ctm_plugin.metrics.evaluate import Scoring
from ctm_plugin.optim.named_optimizers import NamedOptimizers, leave_out
from ctm_plugin.optim.pace import Pace
from ctm_plugin.optim.schedules import Schedule
from ctm_plugin.show.snapshot import Snapshot

PREVIEW_WIDTH = 128
"""Largest width in pixels of a picture that is rendered while training."""
SAMPLE_COLORS = 1 << 15
"""Number of training colours that a transform is fitted to before a field trains."""
PREVIEW_STEPS = 8
"""Most pixels of such a picture, in multiples of ``batch_rays``: between pictures there are hundreds of steps."""

UNLIMITED_STEPS = 1 << 40
"""Step limit of a training that a clock ends."""


@dataclass
class Batch:
    """The input of a training step: the training colours. Subclasses add what else ``predict`` needs."""

    rgb: Tensor
    """``[R, 3]`` in [0, 1]."""


@dataclass
class Rendering:
    """What a backbone predicts for a batch: one or more latents of the same pixels, the best one last."""

    latents: tuple[Tensor, ...]
    """``[R, k]`` each, in [0, 1]."""

    @property
    def latent(self) -> Tensor:
        """Give the best one, ``[R, k]``."""
        return self.latents[-1]


class Compared(NamedTuple):
    """A batch's weighted loss terms by name, and the colours that renderings should have, encoded and in sRGB."""

    terms: dict[str, Tensor]
    target: Tensor
    """``[R, k]``, detached."""
    rgb: Tensor
    """``[R, 3]``."""


class Backbone(L.LightningModule):
    """A field trained in the space of a colour transform that it does not know.

    A subclass gives ``total_steps``, ``draw``, ``scene_colors``, ``predict``, ``field_optimizers`` and, if it has
    any, ``regularisers``, ``field_schedule`` and ``color_biases``; its ``Config`` dataclass is the backbone's part of
    the configuration. What it is scored by, shows and films is its own: ``scores``, ``snapshot``, ``film``.
    The transform is the identity until :class:`ctm_plugin.callbacks.attach_ctm.AttachTransform` puts one there;
    ``appearance`` is what tells the training pictures apart, ``None`` where nothing does.

    Args:
        channels: k, how many channels to render.
        photometric: the distance between colours.
        seed: of all random numbers of the training.
    """

    Config: type
    """Its settings. Their class attribute ``default_dataset`` names the data set that a command line without
    ``dataset=`` then has, where the usual one loads something else."""
    Scene: type = object
    """What a data set must load for it to train on."""
    batch_rays: int
    """Training pixels a batch, over all processes."""
    posed: bool = False
    """Whether its ``scene`` is a :class:`~ctm_plugin.scene.views.Scene` that it renders from any camera, as a
    :class:`~ctm_plugin.backbones.posed.PosedBackbone` does."""
    light: Light = AS_IS
    """Light in which its pictures are displayed."""
    replayed: bool = False
    """Whether a GPU may record its steps: not by default, until ``tests/test_gpu.py`` has passed on a card."""
    loops_only: bool = False
    """Whether on a CPU loops do the work of its steps, so that torch's operators are as quick on one thread."""
    total_steps: int
    """Optimizer steps of a whole training."""
    pace: Pace | None = None
    """Spread of its schedule over the steps, for backbones whose trainings may end earlier or later."""

    def __init__(self, channels: int = 3, photometric: Photometric | None = None, seed: int = 0):
        super().__init__()
        self.channels = channels
        self.transform: ColorTransform = RGB()
        self.appearance: Exposure | None = None
        self.photometric = photometric or Photometric()
        self.seed = seed
        self.batches_seen = 0
        self.terms: dict[str, Tensor] = {}
        self.replay = Replay()
        self.transform_optimizer: Callable[[ColorTransform], tuple[Optimizer, Schedule]] | None = None

    # What a backbone gives.

    def draw(self, draws: Draws) -> Batch:
        """A random batch of training pixels."""
        raise NotImplementedError

    def scene_colors(self, draws: Draws, count: int) -> Tensor:
        """``[count, 3]``: random training colours as evaluation shows them, for what is set before the field trains."""
        raise NotImplementedError

    def some_colors(self) -> Tensor:
        """``[COLORS, 3]`` of them, the same each time."""
        return self.scene_colors(Draws(self.seed, 0, self.device, stream="colors"), SAMPLE_COLORS)

    def predict(self, batch: Batch, draws: Draws) -> Rendering:
        """Render the batch's pixels, for training."""
        raise NotImplementedError

    def regularisers(self, batch: Batch, rendering: Rendering, target: Tensor) -> dict[str, Tensor]:
        """The backbone's own weighted loss terms. ``target`` ``[R, k]``: the encoded training colours."""
        return {}

    def field_optimizers(self) -> dict[str, Optimizer]:
        """The optimizers of the backbone's own parameters, by name.

        Those of ``transform`` and ``appearance`` are left out of ``self.parameters()`` here.
        """
        raise NotImplementedError

    def field_schedule(self) -> Schedule:
        """Factor on their learning rates after so many optimizer steps."""
        return lambda step: 1.0

    def color_biases(self) -> list[Tensor]:
        """``[k]`` each: biases of the last layers before the latents' sigmoid, to begin at the scene's mean colour."""
        return []

    def stats(self) -> dict[str, float]:
        """Numbers worth a curve, such as the occupied fraction of a grid."""
        return {}

    def scores(self, folder: Path, scoring: Scoring) -> dict[str, Any]:
        """Scores of the trained backbone, for ``metrics.json``, and its pictures in ``folder``.

        ``psnr`` is what sweeps that search maximise, ``converged`` false prints "not converged", runs without the same
        ``protocol`` do not share a table.
        """
        return {}

    def snapshot(self) -> Snapshot:
        """Render one small picture next to its target; called in evaluation mode, without gradients."""
        return Snapshot()

    def film(self) -> Float[Tensor, "h w 3"] | None:
        """A picture of the training, some twenty of which become a film; ``None``: there is none."""
        return None

    def cost(self, first: int | float, last: int | float) -> float:
        """How long a step takes from a place of its schedule to another, on average, relative to others of it."""
        return 1.0

    def rays(self, first: int, last: int) -> int | float:
        """How many training pixels optimizer steps from one to another look at, a batch each, over all processes."""
        return (last - first) * self.batch_rays

    # What it gets.

    def compare(self, batch: Batch, latents: list[Tensor], uniform: Uniform) -> Compared:
        """Hold renderings ``[R, k]`` of a batch against its training colours."""
        return Compared(*self.transform.losses(latents, batch.rgb, self.photometric, uniform), batch.rgb)

    @property
    def schedule_steps(self) -> int:
        """Steps of its schedule: those of a whole training, unless time stretches or cuts it."""
        return self.total_steps if self.pace is None else self.pace.planned

    @property
    def scheduled(self) -> int | float:
        """Where in its schedule it is, in steps of it."""
        return self.global_step if self.pace is None else self.pace.place(self.global_step)

    @property
    def between_steps(self) -> bool:
        """Whether the next batch is the first of an optimizer step."""
        return self.batches_seen % self.trainer.accumulate_grad_batches == 0

    def stride(self, height: int, width: int) -> int:
        """Rows and columns from one rendered pixel to the next, of pictures that are rendered while training."""
        return math.ceil(max(width / PREVIEW_WIDTH, (width * height / (PREVIEW_STEPS * self.batch_rays)) ** 0.5))

    @torch.no_grad()
    def decode(self, latent: Tensor) -> Tensor:
        """Latents to RGB in [0, 1], for people and metrics."""
        return self.transform.decode(latent.float()).clamp(0, 1)

    def draws(self, step: int) -> Draws:
        """The random numbers of a step, with this process's share of the rows."""
        trainer = self._trainer
        rank, world = (trainer.global_rank, trainer.world_size) if trainer else (0, 1)
        return Draws(self.seed, step, self.device, rank, world)

    def training_step(self, _: Any, batch_idx: int) -> dict[str, Any]:
        draws = self.draws(self.batches_seen)
        self.batches_seen += 1
        step = self.replay(self, draws) if self.replayed else self.step_of(draws)
        self.terms = step.terms
        return {"loss": step.loss, **step.shown}

    def step_of(self, draws: Draws) -> Step:
        """The losses of a batch, a function of the random numbers and the tensors of the backbone."""
        with record_function("ctm/draw"):
            batch = self.draw(draws)
        with record_function("ctm/field"):
            rendering = self.predict(batch, draws)
        with record_function("ctm/colour"), torch.autocast(self.device.type, enabled=False):
            latents = [latent.float() for latent in rendering.latents]
            terms, target, rgb = self.compare(batch, latents, draws.uniform)
        with record_function("ctm/loss"):
            terms = terms | self.regularisers(batch, rendering, target)
            loss = sum(terms.values())
        shown = {"latent": rendering.latent.detach(), "target": target, "rgb": rgb}
        return Step(loss, {name: term.detach() for name, term in terms.items()}, shown)

    def repeats(self) -> Hashable | None:
        """What a step depends on besides random numbers and tensors, where a GPU may record it; ``None``: it may not.

        Sizes must stay, nothing may be waited for, and no Python number may change from step to step.
        """
        return None

    def fixed_sizes(self) -> AbstractContextManager[None]:
        """Within it, sizes in a step stay, if ever they can."""
        return nullcontext()

    @property
    def known(self) -> bool:
        """Whether all its parts are this package's: others' may do something else in every step."""
        return all(type(part).__module__.partition(".")[0] in ("ctm_plugin", "torch") for part in self.modules())

    def configure_optimizers(self) -> NamedOptimizers:
        members = self.field_optimizers()
        for member in members.values():
            leave_out(member, self._not_the_fields())
        schedules = dict.fromkeys(members, self.field_schedule())
        if self.transform_optimizer is not None:
            members["ctm"], schedules["ctm"] = self.transform_optimizer(self.transform)
        if self.appearance is not None and (own := self.appearance.optimizer(self.schedule_steps)):
            members["appearance"], schedules["appearance"] = own
        return NamedOptimizers(members, schedules)

    def _not_the_fields(self) -> set[Tensor]:
        """Parameters with optimizers of their own."""
        return {
            parameter
            for part in (self.transform, self.appearance)
            if part is not None
            for parameter in part.parameters()
        }

    @property
    def named_optimizers(self) -> NamedOptimizers:
        return self.optimizers(use_pl_optimizer=False)

    @torch.no_grad()
    def on_train_start(self) -> None:
        # Callbacks come first: the transform is what it is when the field's training begins. From the mean colour a
        # dark scene is near; from grey the first steps would drive the sigmoid to where it has no gradient.
        if self.batches_seen == 0 and (biases := self.color_biases()):
            mean = self.transform.encode(self.some_colors()).mean(0).logit(eps=1e-3)
            for bias in biases:
                bias.copy_(mean)

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        self.named_optimizers.set_rates(self.scheduled)

    def on_train_batch_end(self, *_: Any) -> None:
        # For callbacks that read them at the start of a batch, before the hook above, as Lightning's monitor does.
        self.named_optimizers.set_rates(self.scheduled)

    def train_dataloader(self) -> torch.utils.data.DataLoader:
        """One item a batch, empty: batches are drawn on the module's device by (seed, step)."""
        steps = self.total_steps if self.pace is None else UNLIMITED_STEPS
        return torch.utils.data.DataLoader(range(steps * self.trainer.accumulate_grad_batches), batch_size=None)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["batches_seen"] = self.batches_seen
        if self.pace is not None:
            checkpoint["turns"] = [tuple(turn) for turn in self.pace.turns]

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self.batches_seen = checkpoint["batches_seen"]
        if self.pace is not None:
            self.pace = Pace(self.pace.planned, checkpoint.get("turns"))


def rewrap(trainer: L.Trainer) -> None:
    """Wrap the model for DDP anew: its gradient buckets are laid out for the parameters it was wrapped with.

    The old wrapper goes before the new one comes: it holds nodes of the graph that know the parameters' old sizes.
    """
    strategy = trainer.strategy
    if isinstance(strategy, DDPStrategy) and strategy.model is not strategy.lightning_module:
        strategy.model = strategy.lightning_module
        gc.collect()
        strategy.model = strategy._setup_model(strategy.lightning_module)
