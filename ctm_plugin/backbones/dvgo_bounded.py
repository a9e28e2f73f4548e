"""DVGO on bounded scenes: a coarse stage that finds the geometry, a fine stage that fills it."""

from __future__ import annotations

import warnings
from typing import Any

import torch
from torch import Tensor

from ctm_plugin.backbones.base import rewrap
from ctm_plugin.backbones.dvgo import DVGO
from ctm_plugin.backbones.voxels import WorldField
from ctm_plugin.optim.grid_adam import GridAdam
from ctm_plugin.rays.grid import Shape, cubic_shape, voxel_size
from ctm_plugin.scene.frustum import frustum_box, view_counts


class BoundedDVGO(DVGO):
    """Cubic voxels in a box of the world, both stages in one fit."""

    mlp_width, view_frequencies = 128, 4
    coarse_views = 3
    coarse_alpha_init, alpha_init = 1e-6, 1e-2
    coarse_threshold = 1e-7
    box_threshold = 1e-3
    box_scale = 1.05

    def wants_coarse(self) -> bool:
        if self.config.coarse == "auto":
            # It looks for what stands in empty space; a room fills its pictures, corners that few views see too.
            return self.scene.train.has_alpha and not self.scene.dark
        return bool(self.config.coarse)

    def starting_box(self) -> Tensor:
        return frustum_box(self.scene.train, self.scene.near, self.scene.far)

    def world_box(self) -> Tensor:
        return self.field.grid.box

    def make_field(self, box: Tensor, shape: Shape | None = None) -> WorldField:
        coarse, config = self.stage == "coarse", self.config
        return WorldField(
            box,
            shape or (cubic_shape(box, config.coarse_voxels) if coarse else self.grown_shape(box)),
            self.channels if coarse else config.features,
            near=self.scene.near,
            far=self.scene.far,
            threshold=self.coarse_threshold if coarse else config.threshold,
            alpha_init=self.coarse_alpha_init if coarse else self.alpha_init,
            step=config.step_size,
            base_voxel=voxel_size(box, config.coarse_voxels if coarse else config.voxels),
        )

    def grown_shape(self, box: Tensor) -> Shape:
        return cubic_shape(box, self.fine_voxels)

    def grid_optimizer(self) -> GridAdam:
        optimizer = super().grid_optimizer()
        if self.stage == "coarse":
            counts, _ = view_counts(self.field.grid.vertices(), self.scene.train, self.scene.near)
            for group in optimizer.param_groups:
                group["lr"] = self.config.coarse_lr_grid
                group["rates"] = (counts / counts.max().clamp_min(1))[:, None]
        return optimizer

    def on_fit_start(self) -> None:
        if self.global_step == 0 and self.stage == "coarse":
            self.free_what_floats()
        super().on_fit_start()

    @torch.no_grad()
    def free_what_floats(self) -> None:
        """Take coarse voxels that few training views see, or that lie close before a camera, for free.

        Nothing contradicts what fills them.
        """
        field, scene = self.field, self.scene
        seen, too_near = view_counts(field.grid.vertices(), scene.train, scene.near)
        field.occupancy &= seen >= min(self.coarse_views, len(scene.train))
        field.density[too_near] = -100.0

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        if self.stage == "coarse" and self.global_step >= self.fine_start:
            self._start_fine()
        super().on_train_batch_start(batch, batch_idx)

    @torch.no_grad()
    def _start_fine(self) -> None:
        """Build the fine field in a tight box round what the coarse stage found, outside its free space."""
        coarse = self.field
        found = (coarse.alpha() > self.box_threshold).flatten()
        solid = coarse.dilated_alpha() > self.box_threshold
        if not found.any():
            told = "the coarse stage found no surface; the fine stage starts in the whole box"
            warnings.warn(f"{told}: dataset.near and dataset.far may not hold the scene", stacklevel=2)
            found[:] = solid[:] = True
        points = coarse.grid.vertices()[found]
        low, high = points.amin(0), points.amax(0)
        margin = ((high - low) * (self.box_scale - 1) / 2).clamp_min(coarse.grid.voxel)
        self.stage = "fine"
        fine = self.make_field(torch.stack([low - margin, high + margin]).cpu()).to(self.device)
        fine.occupancy = solid[coarse.grid.nearest(fine.grid.vertices())]
        self.field = fine
        self.restart_optimizers()
        self.renew_pool()
        rewrap(self.trainer)
