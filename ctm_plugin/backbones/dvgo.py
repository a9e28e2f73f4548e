"""DVGO: grids of density and features, trained directly (Sun et al., CVPR 2022)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import torch
from torch import Tensor
from torch.optim import Adam, Optimizer

from ctm_plugin.backbones.averaging import Averaging
from ctm_plugin.backbones.base import rewrap
from ctm_plugin.backbones.marching import Samples, distortion_and_occlusion
from ctm_plugin.backbones.radiance import RadianceBackbone, RayBatch, RayRendering
from ctm_plugin.backbones.settings import DVGOConfig
from ctm_plugin.backbones.voxels import ViewMLP, VoxelField
from ctm_plugin.color.photometric import Photometric
from ctm_plugin.draws import Draws, seeded
from ctm_plugin.errors import ConfigError
from ctm_plugin.optim.grid_adam import GridAdam
from ctm_plugin.optim.schedules import Schedule, exponential
from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.grid import Shape, add_smoothing, resample
from ctm_plugin.scene.views import Scene

GEOMETRIES = {"bounded": "dvgo_bounded:BoundedDVGO", "forward": "dvgo_forward:ForwardDVGO"}
"""Which DVGO is for which geometry."""
TV_SIDE = 128
"""Total variation is weighted by the grid's sides over this, as finer grids have smaller differences."""


@dataclass
class VoxelRendering(RayRendering):
    """A rendering with the samples it was made of."""

    samples: Samples


class DVGO(Averaging, RadianceBackbone):
    """DVGO: voxel grids, or planes of voxels, trained in a transform's space.

    ``DVGO(config, ...)`` makes the one for ``config.geometry``.
    Here is the fine stage, which all have. A subclass gives ``starting_box``, ``make_field`` and ``grown_shape``.

    Args:
        config: sizes, steps, rates.
        scene: whose geometry is the configuration's.
        channels, photometric, seed: see :class:`RadianceBackbone`.
    """

    Config = DVGOConfig
    geometries = tuple(GEOMETRIES)
    betas = (0.9, 0.99)
    averaged_parts = ("field", "mlp")
    # The paper's.
    mlp_width: int
    view_frequencies: int
    mlp_depth = 3
    entropy = 0.001
    coarse_point, point = 0.1, 0.01

    def __new__(cls, config: DVGOConfig | None = None, *args: Any, **kwargs: Any) -> DVGO:
        if cls is DVGO:
            module, name = GEOMETRIES[config.geometry or "bounded"].split(":")
            cls = getattr(import_module(f"ctm_plugin.backbones.{module}"), name)
        return super().__new__(cls)

    def __init__(
        self,
        config: DVGOConfig,
        scene: Scene,
        channels: int = 3,
        photometric: Photometric | None = None,
        seed: int = 0,
    ):
        if config.geometry is None and scene.geometry != "bounded":
            expected = f"{' or '.join(GEOMETRIES)}, given as a key: {scene.name} is {scene.geometry}"
            raise ConfigError("backbone.geometry", None, expected)
        super().__init__(scene, config.rays, channels, photometric, seed)
        self.config = config
        coarse = self.wants_coarse()
        self.stage = "coarse" if coarse else "fine"
        self.fine_start = config.coarse_steps if coarse else 0
        self.fine_steps = config.steps if coarse else config.steps_alone
        self.lr_final = config.lr_final if coarse else config.lr_final_alone
        self.grown = 0
        self.dropped = 0.0  # from the shift of the raw densities
        self.sparse = False
        self.relative = config.relative
        self.rays_per_pixel = config.rays_per_pixel
        with seeded(seed):
            self.mlp = ViewMLP(config.features, channels, self.mlp_width, self.mlp_depth, self.view_frequencies)
        self.field = self.make_field(self.starting_box())

    # What a subclass gives.

    def wants_coarse(self) -> bool:
        """Whether a coarse stage comes first."""
        return False

    def starting_box(self) -> Tensor:
        """``[2, 3]``: what the cameras see, in the field's space."""
        raise NotImplementedError

    def make_field(self, box: Tensor, shape: Shape | None = None) -> VoxelField:
        """The fresh field of the present stage over a box ``[2, 3]``; ``shape`` where it has grown already."""
        raise NotImplementedError

    def grown_shape(self, box: Tensor) -> Shape:
        """Vertices of the fine grid over a box ``[2, 3]`` after ``self.grown`` growths."""
        raise NotImplementedError

    @property
    def settled(self) -> int:
        return self.fine_start + max(self.config.grow, default=0)

    @property
    def fine_voxels(self) -> int:
        return int(self.config.voxels / 2 ** (len(self.config.grow) - self.grown))

    def smoothed_sides(self) -> tuple[int, int, int]:
        """Return what the weights of total variation along x, y, z grow with."""
        return (max(self.field.grid.shape),) * 3

    # Training.

    @property
    def total_steps(self) -> int:
        return self.fine_start + self.fine_steps

    def field_optimizers(self) -> dict[str, Optimizer]:
        return {
            "grids": self.grid_optimizer(),
            "mlp": Adam(self.mlp.parameters(), self.config.lr_mlp, self.betas, fused=True),
        }

    def grid_optimizer(self) -> GridAdam:
        """Of the present field's tables."""
        field = self.field
        groups = [{"params": [field.density], "name": "density"}, {"params": [field.features], "name": "features"}]
        return GridAdam(groups, self.config.lr_grid, self.betas)

    def field_schedule(self) -> Schedule:
        coarse = self.stage == "coarse"
        start = 0 if coarse else self.fine_start
        if self.config.restart and self.grown:
            start += self.config.grow[self.grown - 1]
        steps = self.config.lr_decay_steps or max(self.fine_steps, self.fine_start if coarse else 0)
        return exponential(self.lr_final, steps, start)

    def on_fit_start(self) -> None:
        self.sparse = self.allows_sparse()
        self.renew_pool()

    def color_biases(self) -> list[Tensor]:
        return [self.mlp.layers[-1].bias] if self.config.start == "mean" else []

    def allows_sparse(self) -> bool:
        """Whether the tables' gradients may be sparse: nobody clips them or sums them up over processes.

        On a GPU a sparse gradient would wait for the number of its rows.
        """
        trainer = self.trainer
        return self.device.type == "cpu" and trainer.world_size == 1 and trainer.gradient_clip_val is None

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        if self.stage == "fine":
            step = self.global_step - self.fine_start
            while self.grown < len(self.config.grow) and step >= self.config.grow[self.grown]:
                self._grow()
            times, rest = divmod(step, self.config.occupancy_first)
            # Most is found early, and the pool of rays takes as long as ten steps.
            if rest == 0 and times.bit_count() == 1:
                self.field.update_occupancy()
                self.renew_pool()
        super().on_train_batch_start(batch, batch_idx)

    @torch.no_grad()
    def _grow(self) -> None:
        self.grown += 1
        old, shape = self.field.grid.shape, self.grown_shape(self.field.grid.box)
        self.field.resize(shape)
        self._lower_shift(self.config.shift_drop)
        if self.config.restart:
            self.restart_optimizers()
        else:
            self._resample_moments(old, shape)
        self.renew_pool()  # it always follows from the occupancy, so that a resumed run has the same one
        rewrap(self.trainer)

    def restart_optimizers(self) -> None:
        """The field's optimizers and their schedules as for a stage that begins; the transform's go on."""
        optimizers, schedule = self.named_optimizers, self.field_schedule()
        for name, fresh in self.field_optimizers().items():
            optimizers.replace(name, fresh)
            optimizers.schedules[name] = schedule

    def _lower_shift(self, by: float) -> None:
        self.dropped += by
        self.field.vertex_shift = self.field.vertex_shift - by

    def _resample_moments(self, old: Shape, shape: Shape) -> None:
        moments = self.named_optimizers.members["grids"].state
        for table in (self.field.density, self.field.features):
            for name in ("exp_avg", "exp_avg_sq"):
                if table in moments:
                    moments[table][name] = resample(moments[table][name], old, shape)

    def renew_pool(self) -> None:
        """Draw training pixels from the rays that may meet something, once free space is known."""
        if self.field.occupancy.all():
            self.pool = None
            return
        self.draw_those(self.field.hits)

    def render(self, rays: Rays, background: Tensor, draws: Draws | None) -> VoxelRendering:
        offset = 0.5 if draws is None else draws.uniform(len(rays.origins), 1).squeeze(1)
        mlp = None if self.stage == "coarse" else self.shown("mlp")
        field, sparse = self.shown("field"), self.sparse and not self.smooths
        latent, depth, samples = field(rays, background, offset, mlp, sparse)
        return VoxelRendering((latent,), opacity=1 - samples.transmittance, depth=depth, samples=samples)

    def query(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        return self.shown("field").query(points, directions, None if self.stage == "coarse" else self.shown("mlp"))

    def regularisers(self, batch: RayBatch, rendering: VoxelRendering, target: Tensor) -> dict[str, Tensor]:
        """Entropy of the background's share p, ``-p ln p - (1-p) ln(1-p)``, the colour error of each sample, how far
        apart the weights of a ray lie and how close before its camera.

        The second is a photometric term: ``loss.weight`` multiplies it too. ``target``: ``[R, k]``.
        """
        coarse, config, samples = self.stage == "coarse", self.config, rendering.samples
        terms = {}
        if weight := config.coarse_entropy if coarse else self.entropy:
            transmittance = samples.transmittance.clamp(1e-6, 1 - 1e-6)
            entropy = transmittance * transmittance.log() + (1 - transmittance) * torch.log1p(-transmittance)
            terms["entropy"] = weight * -entropy.mean()
        if weight := self.photometric.weight * (self.coarse_point if coarse else self.point):
            error = (samples.latent - target[samples.ray_index]).square().sum(1)
            terms["point"] = weight * (error * samples.weights.detach()).sum() / len(target)
        if not coarse:
            field, weights = self.field, {"apart": config.distortion, "close": config.occlusion}
            terms |= distortion_and_occlusion(samples, len(target), field.near, field.far, field.stride, **weights)
        return terms

    @property
    def smooths(self) -> bool:
        """Whether total variation is taken in this step."""
        some = self.stage == "fine" and (self.config.tv_density or self.config.tv_features)
        return bool(some) and (self.global_step - self.fine_start) % self.config.tv_every == 0

    def on_before_optimizer_step(self, optimizer: Optimizer) -> None:
        """Total variation goes straight into the gradients: as a loss it would need several copies of the grids."""
        if not self.smooths:
            return
        field, config = self.field, self.config
        seen_only = self.global_step - self.fine_start >= config.tv_dense_steps
        for table, weight in ((field.density, config.tv_density), (field.features, config.tv_features)):
            if weight and table.grad is not None:
                each = weight * config.tv_every / config.rays / 6 / TV_SIDE
                x, y, z = self.smoothed_sides()
                add_smoothing(table, field.grid.shape, (each * x, each * y, each * z), seen_only)

    def stats(self) -> dict[str, float]:
        return {"occupied_fraction": self.field.occupancy.float().mean().item()}

    # Checkpoints: the tables' sizes change in training, so that they are built anew before they are loaded.

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        super().on_save_checkpoint(checkpoint)
        grid = self.field.grid
        checkpoint["dvgo"] = {
            "stage": self.stage,
            "grown": self.grown,
            "dropped": self.dropped,
            "loss_scale": self.loss_scale,
            "box": grid.box.cpu(),
            "shape": list(grid.shape),
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        super().on_load_checkpoint(checkpoint)
        saved = checkpoint["dvgo"]
        self.stage, self.grown = saved["stage"], saved["grown"]
        box, shape = saved["box"], tuple(saved["shape"])
        rows = len(checkpoint["state_dict"]["field.density"])
        # What is built must be no larger than what is in the file.
        if self.stage not in ("coarse", "fine") or not 0 <= self.grown <= len(self.config.grow):
            raise ValueError(f"stage {self.stage!r}, grown {self.grown!r} times")
        if not math.isfinite(saved["dropped"]):
            raise ValueError(f"a shift lowered by {saved['dropped']}")
        if len(shape) != 3 or min(shape) < 2 or math.prod(shape) != rows:
            raise ValueError(f"a table of shape {shape} with {rows} rows")
        if box.shape != (2, 3) or not box.isfinite().all() or not (box[1] > box[0]).all():
            raise ValueError(f"a box {box.tolist()}")
        self.field = self.make_field(box, shape).to(self.device)
        self.set_loss_scale(saved["loss_scale"])
        self.dropped = 0.0
        self._lower_shift(saved["dropped"])
        self.make_means(checkpoint["state_dict"])
