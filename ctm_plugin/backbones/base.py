"""What every backbone is: a LightningModule that renders latents and is trained through a colour transform."""

from __future__ import annotations

import gc
import math
from collections.abc import Sequence
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
from torch.utils.data import DataLoader

from ctm_plugin.appearance.exposure import Exposure
from ctm_plugin.backbones.untouched import snapshot
from ctm_plugin.color.light import AS_IS, Light
from ctm_plugin.color.photometric import Photometric
from ctm_plugin.color.prepare import SAMPLE_COLORS, adam_of, prepare
from ctm_plugin.color.spaces.rgb import Space as RGB
from ctm_plugin.color.transform import ColorTransform, Uniform
from ctm_plugin.draws import Draws
from ctm_plugin.metrics.evaluate import Scoring
from ctm_plugin.metrics.table import METRICS
from ctm_plugin.optim.named_optimizers import NamedOptimizers, leave_out
from ctm_plugin.optim.pace import Pace
from ctm_plugin.optim.schedules import Schedule, exponential
from ctm_plugin.show.snapshot import Snapshot

PREVIEW_WIDTH = 128
"""Largest width in pixels of a picture that is rendered while training."""
PREVIEW_STEPS = 8
"""Most pixels of a picture rendered while training, in multiples of ``batch_rays``: hundreds of steps lie between."""

UNLIMITED_STEPS = 1 << 40
"""Step limit of a training that a clock ends."""


@dataclass
class Batch:
    """The input of a training step: the training colours. Subclasses add what else ``predict`` needs."""

    rgb: Tensor
    """Training colours ``[R, 3]``, RGB in [0, 1]."""


@dataclass
class Rendering:
    """What a backbone predicts for a batch: one or more latents of the same pixels, the best one last."""

    latents: tuple[Tensor, ...]
    """Latents of each rendering, ``[R, k]`` in [0, 1], the best one last."""

    @property
    def latent(self) -> Tensor:
        """Give the latents ``[R, k]`` of the best rendering."""
        return self.latents[-1]


class Compared(NamedTuple):
    """A batch's weighted loss terms by name, and the colours that renderings should have, encoded and in sRGB."""

    terms: dict[str, Tensor]
    target: Tensor
    """The encoded training colours ``[R, k]``, detached."""
    rgb: Tensor
    """The training colours ``[R, 3]`` in sRGB."""


class Backbone(L.LightningModule):
    """A field trained in the space of a colour transform that it does not know.

    A subclass gives ``total_steps``, ``draw``, ``scene_colors``, ``predict``, ``field_optimizers`` and, if it has
    any, ``regularisers``, ``field_schedule`` and ``color_biases``; its ``Config`` dataclass is the backbone's part of
    the configuration. What it is scored by, shows and films is its own: ``scores``, ``snapshot``, ``film``.
    ``appearance`` is what tells the training pictures apart, ``None`` where nothing does.

    Args:
        transform: the colour transform whose latents the field renders; ``None``: the identity.
        photometric: the loss between two colours.
        seed: seeds all random numbers of the training.
    """

    Config: type
    """Dataclass of the backbone's settings. Its class attribute ``default_dataset`` names the data set of a command
    line without ``dataset=``, where the usual one loads something else."""
    Scene: type = object
    """Type of scene that a data set must load for the backbone to train on."""
    batch_rays: int
    """Training pixels a batch, over all processes."""
    posed: bool = False
    """Whether the backbone renders its :class:`~ctm_plugin.scene.views.Scene` from any camera, as a
    :class:`~ctm_plugin.backbones.posed.PosedBackbone` does."""
    light: Light = AS_IS
    """Light in which the backbone's pictures are displayed."""
    loops_only: bool = False
    """Whether numba loops do a training step's work on a CPU, so that torch's operators are as quick on one thread."""
    snapshots: Sequence[int] = (0,)
    """Indices of the test views that :meth:`snapshot` renders while training."""
    total_steps: int
    """Optimizer steps of a whole training."""
    pace: Pace | None = None
    """Map from training steps to places of the schedule, for backbones whose training may be stretched or cut."""

    def __init__(
        self, transform: ColorTransform | None = None, photometric: Photometric | None = None, seed: int = 0
    ):  # fmt: skip
        super().__init__()
        self.transform: ColorTransform = RGB() if transform is None else transform
        self.appearance: Exposure | None = None
        self.photometric = photometric or Photometric()
        self.seed = seed
        self.batches_seen = 0
        self.terms: dict[str, Tensor] = {}

    # What a backbone gives.

    def draw(self, draws: Draws) -> Batch:
        """A random batch of training pixels."""
        raise NotImplementedError

    def scene_colors(self, draws: Draws, count: int) -> Tensor:
        """Draw random training colours ``[count, 3]``, as evaluation shows them, to fit the transform to."""
        raise NotImplementedError

    def some_colors(self) -> Tensor:
        """Random training colours ``[SAMPLE_COLORS, 3]``, the same at each call."""
        return self.scene_colors(Draws(self.seed, 0, self.device, stream="colors"), SAMPLE_COLORS)

    def predict(self, batch: Batch, draws: Draws) -> Rendering:
        """Render the batch's pixels, for training."""
        raise NotImplementedError

    def regularisers(self, batch: Batch, rendering: Rendering, target: Tensor) -> dict[str, Tensor]:
        """The backbone's own weighted loss terms. ``target`` ``[R, k]``: the encoded training colours."""
        return {}

    def field_optimizers(self) -> dict[str, Optimizer]:
        """The optimizers of the backbone's own parameters, by name.

        While this runs, ``self.parameters()`` leaves out those of ``transform`` and ``appearance``.
        """
        raise NotImplementedError

    def field_schedule(self) -> Schedule:
        """Schedule of the field's optimizers: the factor on their learning rates after a number of steps."""
        return lambda step: 1.0

    def color_biases(self) -> list[Tensor]:
        """Biases ``[k]`` before the latents' sigmoid, to be set so that the field begins at the scene's mean colour."""
        return []

    def stats(self) -> dict[str, float]:
        """Numbers by name to log as curves, such as the occupied fraction of a grid."""
        return {}

    def scores(self, folder: Path | None, scoring: Scoring) -> dict[str, Any]:
        """Score the trained backbone for ``metrics.json``; write its test pictures to ``folder``, if that is given.

        ``psnr`` is what sweeps that search maximise, ``converged`` false prints "not converged", runs without the same
        ``protocol`` do not share a table.
        """
        return {}

    def snapshot(self, view: int) -> Snapshot:
        """Render a test view, small, next to its target; called in evaluation mode, without gradients."""
        return Snapshot()

    def film(self) -> Float[Tensor, "h w 3"] | None:
        """Render one frame of the training's film, which has some twenty; ``None``: the backbone has no film."""
        return None

    def cost(self, first: int | float, last: int | float) -> float:
        """Mean duration of a training step between two places of the schedule, relative to its other parts."""
        return 1.0

    def rays(self, first: int, last: int) -> int | float:
        """Number of training pixels that optimizer steps ``first`` to ``last`` use, over all processes."""
        return (last - first) * self.batch_rays

    # What it gets.

    @property
    def channels(self) -> int:
        """Number k of latent channels that the backbone renders in place of a colour."""
        return self.transform.channels

    def compare(self, batch: Batch, latents: list[Tensor], uniform: Uniform) -> Compared:
        """Compare renderings ``[R, k]`` of a batch with its training colours by the transform's losses."""
        return Compared(*self.transform.losses(latents, batch.rgb, self.photometric, uniform), batch.rgb)

    @property
    def schedule_steps(self) -> int:
        """Number of steps of the schedule: those of a training, unless a time limit stretches or cuts it."""
        return self.total_steps if self.pace is None else self.pace.planned

    @property
    def scheduled(self) -> int | float:
        """Place of the training in its schedule, in steps of the schedule."""
        return self.global_step if self.pace is None else self.pace.place(self.global_step)

    @property
    def between_steps(self) -> bool:
        """Whether the next batch is the first of an optimizer step."""
        return self.batches_seen % self.trainer.accumulate_grad_batches == 0

    def stride(self, height: int, width: int) -> int:
        """Spacing of the pixels, in rows and columns, that are rendered of a picture of this size while training."""
        return math.ceil(max(width / PREVIEW_WIDTH, (width * height / (PREVIEW_STEPS * self.batch_rays)) ** 0.5))

    @torch.no_grad()
    def decode(self, latent: Tensor) -> Tensor:
        """Decode latents ``[..., k]`` to RGB ``[..., 3]`` in [0, 1], for display and metrics."""
        return self.transform.decode(latent.float()).clamp(0, 1)

    def draws(self, step: int) -> Draws:
        """The random numbers of a step, with this process's share of the rows."""
        trainer = self._trainer
        rank, world = (trainer.global_rank, trainer.world_size) if trainer else (0, 1)
        return Draws(self.seed, step, self.device, rank, world)

    def training_step(self, _: Any, batch_idx: int) -> dict[str, Any]:
        draws = self.draws(self.batches_seen)
        self.batches_seen += 1
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
        self.terms = {name: term.detach() for name, term in terms.items()}
        return {"loss": loss, "latent": rendering.latent.detach(), "target": target, "rgb": rgb}

    def configure_optimizers(self) -> NamedOptimizers:
        members = self.field_optimizers()
        for member in members.values():
            leave_out(member, self._not_the_fields())
        schedules = dict.fromkeys(members, self.field_schedule())
        if own := adam_of(self.transform):
            members["ctm"], schedules["ctm"] = own, exponential(self.transform.learning.lr_decay, self.schedule_steps)
        if self.appearance is not None and (own := self.appearance.optimizer(self.schedule_steps)):
            members["appearance"], schedules["appearance"] = own
        return NamedOptimizers(members, schedules)

    def _not_the_fields(self) -> set[Tensor]:
        """Parameters of the transform and the appearance, which have optimizers of their own."""
        return {
            parameter
            for part in (self.transform, self.appearance)
            if part is not None
            for parameter in part.parameters()
        }

    @property
    def named_optimizers(self) -> NamedOptimizers:
        return self.optimizers(use_pl_optimizer=False)

    def on_fit_start(self) -> None:
        # Before callbacks show what was fitted, when training starts.
        if self.batches_seen == 0:
            adam = self.named_optimizers.members.get("ctm")
            prepare(self.transform, adam, self.scene_colors, self.seed, self.device)

    @torch.no_grad()
    def on_train_start(self) -> None:
        # From the mean colour a dark scene is near; from grey the first steps would drive the sigmoid to where it has
        # no gradient.
        if self.batches_seen == 0 and (biases := self.color_biases()):
            mean = self.transform.encode(self.some_colors()).mean(0).logit(eps=1e-3)
            for bias in biases:
                bias.copy_(mean)

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        self.named_optimizers.set_rates(self.scheduled)

    def on_train_batch_end(self, *_: Any) -> None:
        # For callbacks that read them at the start of a batch, before the hook above, as Lightning's monitor does.
        self.named_optimizers.set_rates(self.scheduled)

    def validation_step(self, view: Tensor | int, batch_idx: int) -> Snapshot:
        """Render a test view, small; log the scores of :meth:`snapshot` as ``val/psnr`` and the like."""
        seen = snapshot(self, int(view))
        self.log_dict({f"val/{name}": value for name, value in seen.scores.items()}, batch_size=1, sync_dist=True)
        return seen

    def test_step(self, batch: Any, batch_idx: int) -> None:
        """Render all test views at full size; log the metrics of :meth:`scores` as ``test/psnr`` and the like."""
        scores = {name: value for name, value in self.scores(None, Scoring()).items() if name in METRICS}
        scores = {f"test/{name}": value for name, value in scores.items() if value is not None}
        self.log_dict(scores, batch_size=1, sync_dist=True)

    def val_dataloader(self) -> DataLoader:
        # Of a generator of its own: an iterator else draws from that of the training.
        return DataLoader(self.snapshots, batch_size=None, generator=torch.Generator())

    def test_dataloader(self) -> DataLoader:
        """One item: :meth:`test_step` scores all test views at once."""
        return DataLoader(range(1), batch_size=None)

    def train_dataloader(self) -> DataLoader:
        """One item a batch, empty: batches are drawn on the module's device by (seed, step)."""
        steps = self.total_steps if self.pace is None else UNLIMITED_STEPS
        return DataLoader(range(steps * self.trainer.accumulate_grad_batches), batch_size=None)

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
        strategy.configure_ddp()
