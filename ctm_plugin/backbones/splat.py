"""Gaussian splats (Kerbl et al., SIGGRAPH 2023), whose constants meet colours as a transform encodes them."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from ctm_plugin.backbones.base import rewrap
from ctm_plugin.backbones.pictures import PictureBackbone, PictureBatch, PictureRendering, RenderedView
from ctm_plugin.backbones.settings import SplatConfig
from ctm_plugin.color.dssim import dssim
from ctm_plugin.color.photometric import Photometric
from ctm_plugin.color.transform import ColorTransform
from ctm_plugin.draws import Draws
from ctm_plugin.optim.grid_adam import GridAdam
from ctm_plugin.optim.named_optimizers import NamedOptimizers
from ctm_plugin.optim.pace import Pace
from ctm_plugin.optim.schedules import exponential
from ctm_plugin.scene.views import Scene, Views
from ctm_plugin.splats.coarse_to_fine import Stage, averaged, stages
from ctm_plugin.splats.gaussians import Camera, Gaussians, camera_of
from ctm_plugin.splats.growth import Change, along_curve, densify
from ctm_plugin.splats.render import INVERSE_CHANNELS, PLANE_CHANNELS, bends, expected_depth, picture
from ctm_plugin.splats.seen import as_wide_as_pixels
from ctm_plugin.splats.start import SH_C0, first_gaussians, first_places

MIN_RANGE = 0.002
"""Least range that a scene's colours count as filling: half a grey level."""
NEAR_FRACTION = 0.2
"""Near plane of a picture, as a share of the scene's near bound."""
RESET_OPACITY = 0.01
"""Largest opacity after a reset (3DGS)."""
LR_MEANS_FINAL = 0.01
"""Factor that the learning rate of means has fallen to at the last step."""
SPLAT_COST = 0.7
"""Cost of rendering the full number of Gaussians, where a step's pixels cost 1."""
PARTS = 64
"""Number of equal parts in which the cost of a range of steps is summed."""
CAP_VIEWS = 40
"""Least number of training views that the cap of Gaussians counts: few views of a scene show as much detail as many."""
MIN_SHARE = 0.01
"""Least part of a pixel's variance that is filled: lenses of one capture differ by less."""


class Splat(PictureBackbone):
    """Gaussians that are trained view by view.

    A rendered value v stands for the latent ``low + range v``: the training colours, encoded, fill [0, 1] in v. So
    their constants meet the same colours in any space, and in the dark as in the light.

    Args:
        config: sizes, steps, rates.
        scene: with the points to begin at, if it has them.
        transform, photometric, seed: see :class:`~ctm_plugin.backbones.base.Backbone`.
    """

    Config = SplatConfig
    betas = (0.9, 0.999)
    loops_only = True
    max_scale = 2.0
    """Twice as wide, pictures are .04 dB closer to larger photographs than enlarged ones (RealX3D's MilkCookie)."""

    def __init__(
        self, config: SplatConfig, scene: Scene, transform: ColorTransform | None = None,
        photometric: Photometric | None = None, seed: int = 0,
    ):  # fmt: skip
        super().__init__(scene, config.views, transform, photometric, seed)
        self.config = config
        self.low, self.range = 0.0, 1.0
        self.dssim = config.dssim if self.photometric.kind == "l1" else 0.0
        self.set_loss_scale(1 - self.dssim)
        places, self.first_colors = first_places(scene, config.first, seed)
        first = first_gaussians(places, torch.full((len(places), self.channels), 0.5), config.degree)
        self.tables = nn.ParameterDict({name: nn.Parameter(table) for name, table in first._asdict().items()})
        self.register_buffer("grad2d", torch.zeros(len(places)))
        self.register_buffer("grad2d_count", torch.zeros(len(places)))
        centres = scene.train.c2w[:, :, 3]
        self.extent = max(1.1 * float((centres - centres.mean(0)).norm(dim=1).max()), 1e-6)
        pixels = max(len(self.views), CAP_VIEWS) * self.views.height * self.views.width
        self.cap_max = max(len(places), int(config.per_pixel * pixels))
        self.pace = Pace(config.steps)
        self.side = 1
        self.cameras: dict[int, Camera] = {}
        self.depths: list[Tensor] = []
        self.shifts: list[tuple[Tensor, Tensor]] = []

    @property
    def total_steps(self) -> int:
        return self.pace.end

    @property
    def gaussians(self) -> Gaussians:
        return Gaussians(**self.tables)

    @property
    def degrees(self) -> int:
        """How many degrees of harmonics are in use, the constant one included."""
        fitting = self._trainer and self._trainer.state.fn == "fit"  # to others its steps are unknown
        step = self.scheduled if fitting else self.schedule_steps
        return 1 + min(self.config.degree, int(step) // self.config.degree_every)

    # Training.

    @cached_property
    def stages(self) -> list[Stage]:
        """Parts of the schedule that train on downscaled pictures; computed when a training begins."""
        return stages(self.scene.train) if self.config.coarse else []

    def side_at(self, step: int | float) -> int:
        """Side in pixels of the squares that are averaged into one pixel at a step of the schedule."""
        done = step / self.schedule_steps
        return next((stage.side for stage in self.stages if done < stage.until), 1)

    def cost(self, first: int | float, last: int | float) -> float:
        """Mean relative cost of a step: its share of pixels plus ``0.7 x^2``, x its share of the growth (measured)."""
        step, until = max(last - first, 1) / PARTS, max(self.config.grow_until, 1)
        places = [first + (part + 0.5) * step for part in range(PARTS)]
        return sum(1 / self.side_at(place) ** 2 + SPLAT_COST * min(place / until, 1) ** 2 for place in places) / PARTS

    def rays(self, first: int, last: int) -> int | float:
        shares = (1 / self.side_at(self.pace.place(step)) ** 2 for step in range(first, last))
        return self.batch_rays * sum(shares)

    def field_optimizers(self) -> dict[str, Optimizer]:
        config, tables = self.config, self.tables
        rates = {"scales": config.lr_scales, "quats": config.lr_quats, "opacities": config.lr_opacities}
        rates |= {"sh0": config.lr_sh0, "shN": config.lr_sh0 * config.lr_rest}
        groups = [{"params": [tables[name]], "lr": rate, "name": name} for name, rate in rates.items()]
        means = [{"params": [tables["means"]], "lr": config.lr_means * self.extent, "name": "means"}]
        return {
            "means": GridAdam(means, betas=self.betas, eps=1e-15),
            "splats": GridAdam(groups, betas=self.betas, eps=1e-15),
        }

    def configure_optimizers(self) -> NamedOptimizers:
        optimizers = super().configure_optimizers()
        optimizers.schedules["means"] = exponential(LR_MEANS_FINAL, self.schedule_steps)
        optimizers.schedules["splats"] = exponential(self.config.lr_final, self.schedule_steps)
        return optimizers

    @torch.no_grad()
    def on_train_start(self) -> None:
        super().on_train_start()
        if self.batches_seen:
            return
        if self.config.relative:
            self.find_range()
        colors = self.transform.encode(self.first_colors.to(self.device))
        self.tables["sh0"].copy_(((colors - self.low) / self.range - 0.5) / SH_C0)

    def find_range(self) -> None:
        """Find the range of the training colours' latents, and scale the loss by it."""
        colors = self.some_colors()
        ends = torch.tensor([0.001, 0.999], device=self.device)
        spans = [torch.quantile(each, ends, dim=0) for each in (self.transform.encode(colors), colors)]
        # A transform that is not trained yet may have next to none.
        widest = max(float((high - low).max()) for low, high in spans)
        self.set_range(float(spans[0][0].min()), max(widest, MIN_RANGE))

    def set_range(self, low: float, span: float) -> None:
        """Let the latents from ``low`` to ``low + span > low`` be 0 to 1 of what Gaussians render, else ValueError."""
        if not (math.isfinite(low) and 0 < span < math.inf):
            raise ValueError(f"colours from {low} over {span}")
        self.low, self.range = low, span
        self.set_loss_scale((1 - self.dssim) / (span if self.photometric.kind == "l1" else span**2))

    def render(self, views: Views, index: int, background: Tensor, draws: Draws | None, every: int = 1) -> RenderedView:
        camera = self._camera(views, index, every)
        depth, inverse_depth = draws is None, draws is not None and self.config.bend > 0
        shift = torch.zeros(len(self.grad2d), 2, device=self.device, requires_grad=not depth)
        more = PLANE_CHANNELS if depth else INVERSE_CHANNELS * inverse_depth
        gaussians = self._without_gaps(camera) if depth else self.gaussians
        with torch.autocast(self.device.type, enabled=False):
            image, transmittance = picture(gaussians, camera, shift, self.degrees, -self.low / self.range, more)
            colors = (
                image[: self.channels] + transmittance * ((background.float() - self.low) / self.range).T[:, :, None]
            )
        if not depth:
            self.depths += [image[-1] / NEAR_FRACTION] if inverse_depth else []
            self.shifts.append((shift, shift.new_tensor([camera.width / 2, camera.height / 2])))
        distance = expected_depth(image, transmittance, camera, self.scene.far) if depth else None
        return RenderedView((self.low + self.range * colors).permute(1, 2, 0), 1 - transmittance, distance)

    def predict(self, batch: PictureBatch, draws: Draws) -> PictureRendering:
        self.depths.clear()
        self.shifts.clear()  # of steps that no Trainer took
        return super().predict(batch, draws)

    def _without_gaps(self, camera: Camera) -> Gaussians:
        """The Gaussians, wider where a camera's pixels are smaller than those of all training views.

        A picture adds a variance of 0.3 pixels squared: of finer pixels that is less, and gaps open.
        """
        focal = float(self.views.intrinsics[:, :2].mean(1).max())
        share = 1 - (focal / float(camera.lens[:2].mean())) ** 2
        if share <= MIN_SHARE:
            return self.gaussians
        known = [self._camera(self.views, index, 1) for index in range(len(self.views))]
        return as_wide_as_pixels(self.gaussians, known, share)

    def _camera(self, views: Views, index: int, every: int) -> Camera:
        """The view's camera, cached for training views: finding where a lens ends takes a while."""
        kept = self.cameras if views is self.views and every == 1 else {}
        if index not in kept:
            kept[index] = camera_of(views, index, NEAR_FRACTION * self.scene.near, every).on(self.device)
        return kept[index]

    def regularisers(self, batch: PictureBatch, rendering: PictureRendering, target: Tensor) -> dict[str, Tensor]:
        """D-SSIM in [0, 1], masked pixels taken as equal; bends; mean opacity and scale of the Gaussians."""
        terms, config = {}, self.config
        if self.dssim:
            targets = self._pictured(batch, rendering, target)
            with torch.autocast(self.device.type, enabled=False):  # variances want more than half precision
                parts = [
                    dssim(((picture.latent - self.low) / self.range).permute(2, 0, 1), wanted)
                    for picture, wanted in zip(rendering.pictures, targets, strict=True)
                ]
            terms["dssim"] = self.dssim / len(parts) * sum(parts)
        if config.bend:
            parts = [
                bends(inverse, seen.opacity, (seen.latent.detach() - self.low) / self.range)
                for inverse, seen in zip(self.depths, rendering.pictures, strict=True)
            ]
            terms["bend"] = config.bend / len(parts) * sum(parts)
        if config.opacity:
            terms["opacity"] = config.opacity * self.tables["opacities"].sigmoid().mean()
        if config.size:
            terms["size"] = config.size / self.extent * self.tables["scales"].exp().mean()
        return terms

    def _pictured(self, batch: PictureBatch, rendering: PictureRendering, target: Tensor) -> list[Tensor]:
        """The encoded training colours as pictures ``[k, H, W]`` of [0, 1]."""
        seen = [rendered.latent.detach().flatten(0, 1) for rendered in rendering.pictures]
        if batch.counted is None:
            wanted = target.split([len(each) for each in seen])
        else:
            parts = target.split([len(at) for at in batch.counted])
            wanted = [whole.index_copy(0, *part) for whole, *part in zip(seen, batch.counted, parts, strict=True)]
        shape = rendering.pictures[0].opacity.shape
        return [((each - self.low) / self.range).T.unflatten(1, shape).contiguous() for each in wanted]

    @torch.no_grad()
    def on_after_backward(self) -> None:
        trainer = self._trainer
        # A step's loss is a mean over its views, and batches: what pulls is a view's own.
        views = len(self.shifts) * (trainer.accumulate_grad_batches if trainer else 1)
        lengths = [views * (shift.grad * half).norm(dim=1) for shift, half in self.shifts if shift.grad is not None]
        self.shifts.clear()
        if lengths:
            counted = torch.stack([sum(lengths), sum((each > 0).float() for each in lengths)])
            if trainer and trainer.world_size > 1:  # at once, so that checkpoints hold those of all processes
                counted = trainer.strategy.reduce(counted, reduce_op="sum")
            self.grad2d += counted[0]
            self.grad2d_count += counted[1]

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        config, step = self.config, self.global_step
        if self.between_steps and (side := self.side_at(self.scheduled)) != self.side:
            self.side = side
            self.cameras.clear()
            self.learn_from(self.scene.train if side == 1 else averaged(self.scene.train, side))
        # By the schedule: what `self.side` was says nothing in a run that is gone on with.
        if self.between_steps and step and self.side != self.side_at(self.pace.place(step - 1)):
            self._forget(*self.tables.values())
        grows = self.pace.passes(step, config.grow_every) and self.scheduled >= config.grow_from
        if self.between_steps and grows:
            self._grow(step)
        super().on_train_batch_start(batch, batch_idx)

    @torch.no_grad()
    def _grow(self, step: int) -> None:
        config, grows = self.config, self.scheduled <= self.config.grow_until
        grad2d = self.grad2d / self.grad2d_count.clamp_min(1)
        normal = Draws(self.seed, step, self.device, stream="growth").normal(len(grad2d), 6)
        threshold = config.threshold if grows else math.inf
        change = densify(self.gaussians, grad2d, threshold, self.extent, self.cap_max, config.pruned, normal)
        self._replace(change)
        if grows and config.reset_every and self.pace.passes(step, config.reset_every):
            self._reset()
        rewrap(self.trainer)

    def _replace(self, change: Change) -> None:
        """Replace rows of the Gaussians' parameters and of Adam's moments, and order them :func:`along_curve`.

        Each table is a new parameter: the graph of an earlier step, if it still lives, knows the old one's size.
        """
        order = along_curve(torch.cat([self.tables["means"][change.kept], change.added.means]))
        for name, added in change.added._asdict().items():
            old = self.tables[name]
            self.tables[name] = table = nn.Parameter(torch.cat([old[change.kept], added])[order])
            state = self.named_optimizers.exchange(old, table)
            for moment in ("exp_avg", "exp_avg_sq"):
                if moment in state:
                    state[moment] = torch.cat([state[moment][change.kept], torch.zeros_like(added)])[order]
        self.grad2d = torch.zeros(len(self.tables["means"]), device=self.device)
        self.grad2d_count = torch.zeros_like(self.grad2d)

    def _reset(self) -> None:
        """Make all Gaussians nearly transparent: those that the pictures need regain opacity, floaters do not."""
        table = self.tables["opacities"]
        table.clamp_(max=math.log(RESET_OPACITY / (1 - RESET_OPACITY)))
        self._forget(table)

    def _forget(self, *tables: Tensor) -> None:
        """Put Adam's moments to zero, as new Gaussians have them: steps are large until the second one has grown."""
        for table in tables:
            for moment in self.named_optimizers.state.get(table, {}).values():
                if isinstance(moment, Tensor):
                    moment.zero_()

    def stats(self) -> dict[str, float]:
        return {"gaussians": float(len(self.grad2d))}

    # Checkpoints: their number changes in training, so that the tables are built anew before they are loaded.

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        super().on_save_checkpoint(checkpoint)
        checkpoint["splat"] = {"low": self.low, "range": self.range}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        super().on_load_checkpoint(checkpoint)
        count = len(checkpoint["state_dict"]["tables.means"])
        for table in self.tables.values():
            table.data = table.new_zeros(count, table.shape[1])
        self.grad2d, self.grad2d_count = (table.new_zeros(count) for table in (self.grad2d, self.grad2d_count))
        self.set_range(checkpoint["splat"]["low"], checkpoint["splat"]["range"])
