"""DVGO: grids of density and features, trained directly (Sun et al., CVPR 2022)."""

from __future__ import annotations

import math
import warnings
from typing import Any

import torch
from torch import Tensor
from torch.optim import Adam, Optimizer

from ctm_plugin.backbones.base import rewrap
from ctm_plugin.backbones.networks import ViewMLP
from ctm_plugin.backbones.occupied import OccupiedBackbone, OccupiedRendering
from ctm_plugin.backbones.radiance import RayBatch
from ctm_plugin.backbones.settings import DVGO_GEOMETRIES, DVGOConfig
from ctm_plugin.backbones.spaces import space_of
from ctm_plugin.backbones.voxels import VoxelField
from ctm_plugin.color.photometric import Photometric
from ctm_plugin.color.transform import ColorTransform
from ctm_plugin.draws import seeded
from ctm_plugin.errors import ConfigError
from ctm_plugin.optim.grid_adam import GridAdam
from ctm_plugin.optim.schedules import Schedule, exponential
from ctm_plugin.rays.grid import Shape, add_smoothing, cubic_shape, plane_shape, resample, voxel_size
from ctm_plugin.scene.frustum import view_counts
from ctm_plugin.scene.views import Scene

NETWORKS = {"bounded": (128, 3, 4), "forward": (64, 3, 0)}
"""(width, depth, frequencies) of the paper's colour network by geometry; 0 frequencies: it gets the plain direction."""
TV_SIDE = 128
"""Voxels a side at which total variation has its set weight; finer grids have smaller differences, so it grows with
them."""
BASE_PLANES = 256
"""Number of planes at which one plane's optical depth is ``softplus(raw density)``; fewer planes are thicker."""


class DVGO(OccupiedBackbone):
    """DVGO: voxel grids, or planes of voxels, trained in a transform's space.

    In a box of the world voxels are cubic, and a coarse stage may find what the fine one fills. In front of
    forward-facing cameras there are planes in NDC, with total variation and distortion losses (DVGO's own for LLFF).

    Args:
        config: sizes, steps, rates.
        scene: training and test views; its geometry must be the configuration's.
        transform, photometric, seed: see :class:`~ctm_plugin.backbones.radiance.RadianceBackbone`.
    """

    Config = DVGOConfig
    geometries = DVGO_GEOMETRIES
    field: VoxelField
    betas = (0.9, 0.99)
    entropy = 0.001
    coarse_point, point = 0.1, 0.01
    coarse_views = 3
    coarse_alpha_init, alpha_init = 1e-6, 1e-2
    coarse_alpha_thre = 1e-7
    bbox_thre = 1e-3
    box_scale = 1.05

    def __init__(
        self, config: DVGOConfig, scene: Scene, transform: ColorTransform | None = None,
        photometric: Photometric | None = None, seed: int = 0,
    ):  # fmt: skip
        if config.geometry is None and scene.geometry != "bounded":
            expected = f"{' or '.join(DVGO_GEOMETRIES)}, given as a key: {scene.name} is {scene.geometry}"
            raise ConfigError("backbone.geometry", None, expected)
        super().__init__(config, scene, transform, photometric, seed)
        self.geometry = config.geometry or "bounded"
        coarse = self.wants_coarse()
        self.stage = "coarse" if coarse else "fine"
        self.fine_start = config.coarse_steps if coarse else 0
        self.fine_steps = config.steps if coarse else config.steps_alone
        self.lr_final = config.lr_final if coarse else config.lr_final_alone
        self.grown = 0
        self.dropped = 0.0  # from the shift of the raw densities
        with seeded(seed):
            color = ViewMLP(config.features, self.channels, *NETWORKS[self.geometry])
        self.field = self.make_field(color)

    def wants_coarse(self) -> bool:
        """Whether a coarse stage comes first."""
        if self.geometry == "bounded" and self.config.coarse == "auto":
            # It looks for what stands in empty space; a room fills its pictures, corners that few views see too.
            return self.scene.train.has_alpha and not self.scene.dark
        return self.geometry == "bounded" and bool(self.config.coarse)

    def make_field(self, color: ViewMLP, box: Tensor | None = None, shape: Shape | None = None) -> VoxelField:
        """Make a fresh field for the present stage over a box ``[2, 3]``, by default all that the cameras see;
        ``shape``: vertices a side, where the grid has grown already.
        """
        coarse, config, space = self.stage == "coarse", self.config, space_of(self.scene, self.geometry, box)
        shape = shape or (cubic_shape(space.aabb, config.coarse_voxels) if coarse else self.grown_shape(space.aabb))
        if self.geometry == "forward":
            shift, planes = plane_shift(shape[2]), shape[2]
            space.measure = planes / (planes - 1) / BASE_PLANES
        else:
            shift = math.log(1 / (1 - (self.coarse_alpha_init if coarse else self.alpha_init)) - 1)
            space.measure = voxel_size(space.aabb, config.coarse_voxels if coarse else config.voxels)
        return VoxelField(
            space,
            shape,
            self.channels if coarse else config.features,
            color,
            direct=coarse,
            alpha_thre=self.coarse_alpha_thre if coarse else config.threshold,
            step=config.step_size,
            shift=shift - self.dropped,
        )

    def grown_shape(self, box: Tensor) -> Shape:
        """Vertices of the fine grid over a box ``[2, 3]`` after ``self.grown`` growths."""
        voxels = int(self.config.voxels / 2 ** (len(self.config.grow) - self.grown))
        return plane_shape(box, voxels, self.config.planes) if self.geometry == "forward" else cubic_shape(box, voxels)

    @property
    def settled(self) -> int:
        return self.fine_start + max(self.config.grow, default=0)

    def world_box(self) -> Tensor:
        return self.field.grid.aabb if self.geometry == "bounded" else super().world_box()

    # Training.

    @property
    def total_steps(self) -> int:
        return self.fine_start + self.fine_steps

    def field_optimizers(self) -> dict[str, Optimizer]:
        return {
            "grids": self.grid_optimizer(),
            "mlp": Adam(self.field.color.parameters(), self.config.lr_mlp, self.betas, fused=True),
        }

    def grid_optimizer(self) -> GridAdam:
        """Optimizer of the field's tables; in the coarse stage a voxel's rate grows with the cameras that see it."""
        field = self.field
        groups = [{"params": [field.density], "name": "density"}, {"params": [field.features], "name": "features"}]
        if self.stage == "fine":
            return GridAdam(groups, self.config.lr_grid, self.betas)
        counts, _ = view_counts(field.grid.vertices(), self.scene.train, self.scene.near)
        rates = (counts / counts.max().clamp_min(1))[:, None]
        return GridAdam([group | {"rates": rates} for group in groups], self.config.coarse_lr_grid, self.betas)

    def field_schedule(self) -> Schedule:
        coarse = self.stage == "coarse"
        start = 0 if coarse else self.fine_start
        if self.config.restart and self.grown:
            start += self.config.grow[self.grown - 1]
        steps = self.config.lr_decay_steps or max(self.fine_steps, self.fine_start if coarse else 0)
        return exponential(self.lr_final, steps, start)

    def on_fit_start(self) -> None:
        super().on_fit_start()
        if self.global_step == 0 and self.stage == "coarse":
            self.free_what_floats()
        self.renew_pool()

    @torch.no_grad()
    def free_what_floats(self) -> None:
        """Free coarse voxels that few training views see, or that lie close before a camera: floaters start there.

        Nothing contradicts what fills them.
        """
        field, scene = self.field, self.scene
        seen, too_near = view_counts(field.grid.vertices(), scene.train, scene.near)
        field.occupancy &= seen >= min(self.coarse_views, len(scene.train))
        field.density.data[too_near] = -100.0

    def renew_pool(self) -> None:
        """Draw training pixels from the rays that may meet an occupied voxel, once free space is known.

        In front of a forward-facing scene nearly every ray does.
        """
        if self.geometry == "forward" or self.field.occupancy.all():
            self.pool = None
        else:
            self.draw_those(self.field.hits)

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        if self.stage == "coarse" and self.global_step >= self.fine_start:
            self._start_fine()
        if self.stage == "fine":
            step = self.global_step - self.fine_start
            while self.grown < len(self.config.grow) and step >= self.config.grow[self.grown]:
                self._grow()
            times, rest = divmod(step, self.config.occupancy_first)
            # Most is found early, and the pool of rays takes as long as ten steps.
            if rest == 0 and times.bit_count() == 1:
                self.field.update_occupancy()
                self.renew_pool()
        # Nobody may clip the tables' gradients or sum them up over processes, and smoothing fills them. On a GPU a
        # sparse one would wait for the number of its rows.
        trainer, on_cpu = self.trainer, self.device.type == "cpu"
        alone = trainer.world_size == 1 and trainer.gradient_clip_val is None
        self.field.sparse = on_cpu and alone and not self.smooths
        super().on_train_batch_start(batch, batch_idx)

    @torch.no_grad()
    def _start_fine(self) -> None:
        """Build the fine field in a tight box round the coarse stage's surface, without its free space."""
        coarse = self.field
        dense = (coarse.alpha() > self.bbox_thre).flatten()
        solid = coarse.dilated_alpha() > self.bbox_thre
        if not dense.any():
            message = "the coarse stage found no surface; the fine stage starts in the whole box"
            warnings.warn(f"{message}: dataset.near and dataset.far may not hold the scene", stacklevel=2)
            dense[:] = solid[:] = True
        points = coarse.grid.vertices()[dense]
        low, high = points.amin(0), points.amax(0)
        margin = ((high - low) * (self.box_scale - 1) / 2).clamp_min(coarse.grid.voxel)
        self.stage = "fine"
        fine = self.make_field(coarse.color, torch.stack([low - margin, high + margin]).cpu()).to(self.device)
        fine.occupancy = solid[coarse.grid.nearest(fine.grid.vertices())]
        self.field = fine
        self._changed(restart=True)

    @torch.no_grad()
    def _grow(self) -> None:
        self.grown += 1
        old, shape = self.field.grid.shape, self.grown_shape(self.field.grid.aabb)
        self.field.resize(shape)
        self.dropped += self.config.shift_drop
        self.field.vertex_shift = self.field.vertex_shift - self.config.shift_drop
        if not self.config.restart:
            moments = self.named_optimizers.members["grids"].state
            for table in (self.field.density, self.field.features):
                for name in ("exp_avg", "exp_avg_sq") if table in moments else ():
                    moments[table][name] = resample(moments[table][name], old, shape)
        self._changed(self.config.restart)

    def _changed(self, restart: bool) -> None:
        """Renew the pixel pool and DDP for a field of another size; ``restart``: also the field's optimizers and their
        schedules, while the transform's go on.
        """
        if restart:
            optimizers, schedule = self.named_optimizers, self.field_schedule()
            for name, fresh in self.field_optimizers().items():
                optimizers.replace(name, fresh)
                optimizers.schedules[name] = schedule
        self.renew_pool()  # it always follows from the occupancy, so that a resumed run has the same one
        rewrap(self.trainer)

    def regularisers(self, batch: RayBatch, rendering: OccupiedRendering, target: Tensor) -> dict[str, Tensor]:
        """Entropy of the background's share p, ``-p ln p - (1-p) ln(1-p)``, the colour error of each sample, and in the
        fine stage those of every occupied field.

        The second is a photometric term: ``loss.weight`` multiplies it too. ``target``: ``[R, k]``.
        """
        coarse, samples, terms = self.stage == "coarse", rendering.samples, {}
        if weight := self.config.coarse_entropy if coarse else self.entropy:
            transmittance = samples.transmittance.clamp(1e-6, 1 - 1e-6)
            entropy = transmittance * transmittance.log() + (1 - transmittance) * torch.log1p(-transmittance)
            terms["entropy"] = weight * -entropy.mean()
        if weight := self.photometric.weight * (self.coarse_point if coarse else self.point):
            error = (samples.latent - target[samples.ray_index]).square().sum(1)
            terms["point"] = weight * (error * samples.weights.detach()).sum() / len(target)
        return terms if coarse else terms | super().regularisers(batch, rendering, target)

    @property
    def smooths(self) -> bool:
        """Whether the present step adds the gradient of total variation."""
        some = self.stage == "fine" and (self.config.tv_density or self.config.tv_features)
        return bool(some) and (self.global_step - self.fine_start) % self.config.tv_every == 0

    def on_before_optimizer_step(self, optimizer: Optimizer) -> None:
        """Total variation goes straight into the gradients: as a loss it would need several copies of the grids."""
        if not self.smooths:
            return
        field, config = self.field, self.config
        seen_only = self.global_step - self.fine_start >= config.tv_dense_steps
        x, y, z = field.grid.shape
        sides = (max(x, y), max(x, y), z) if self.geometry == "forward" else (max(x, y, z),) * 3
        for table, weight in ((field.density, config.tv_density), (field.features, config.tv_features)):
            if weight and table.grad is not None:
                each = weight * config.tv_every / config.rays / 6 / TV_SIDE
                add_smoothing(table, field.grid.shape, tuple(each * side for side in sides), seen_only)

    # Checkpoints: the tables' sizes change in training, so that they are built anew before they are loaded.

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        super().on_save_checkpoint(checkpoint)
        grid = self.field.grid
        checkpoint["dvgo"] = {
            "stage": self.stage,
            "grown": self.grown,
            "dropped": self.dropped,
            "box": grid.aabb.cpu(),
            "shape": list(grid.shape),
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        saved = checkpoint["dvgo"]
        self.stage, self.grown, self.dropped = saved["stage"], saved["grown"], saved["dropped"]
        self.field = self.make_field(self.field.color, saved["box"], tuple(saved["shape"])).to(self.device)
        super().on_load_checkpoint(checkpoint)


def plane_shift(planes: int) -> Tensor:
    """The shifts ``[D]`` of the raw densities of D planes of a fresh grid that give all the same weight, so that no
    depth is preferred: the i-th has ``alpha_i = g / (1 - i g)``, ``g = 1/D - 1e-6``.
    """
    each = 1 / planes - 1e-6
    alpha = each / (1 - each * torch.arange(planes, dtype=torch.float64))
    # softplus(shift) BASE_PLANES / D = -ln(1 - alpha): one step of a whole plane has that alpha.
    return torch.expm1(-torch.log1p(-alpha) * planes / BASE_PLANES).log().float()
