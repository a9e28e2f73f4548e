"""NGP: a multiresolution hash grid, in a box, in NDC or in all of space (Müller et al., SIGGRAPH 2022)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.optim import Adam, Optimizer

from ctm_plugin.backbones.hashed import HashField
from ctm_plugin.backbones.occupied import OccupiedBackbone
from ctm_plugin.backbones.radiance import check_geometry
from ctm_plugin.backbones.settings import NGPConfig
from ctm_plugin.backbones.spaces import space_of
from ctm_plugin.color.photometric import Photometric
from ctm_plugin.color.transform import ColorTransform
from ctm_plugin.draws import Draws, seeded
from ctm_plugin.optim.grid_adam import GridAdam
from ctm_plugin.optim.schedules import Schedule, exponential
from ctm_plugin.rays.hash_grid import HashGrid
from ctm_plugin.scene.frustum import visual_hull
from ctm_plugin.scene.views import Scene

SETTLING_UPDATES = 16
"""Updates of the occupancy before free cells become permanently free."""
FOREGROUND_PIXELS = 1 << 16
"""Number of foreground pixels whose rays must still hit an occupied cell once free cells are permanent."""


class NGP(OccupiedBackbone):
    """NGP: a multiresolution hash grid, trained in a transform's space.

    Args:
        config: sizes, steps, rates.
        scene: its geometry must be the configuration's.
        transform, photometric, seed: see :class:`~ctm_plugin.backbones.radiance.RadianceBackbone`.
    """

    Config = NGPConfig
    eval_chunk = 4096

    def __init__(
        self, config: NGPConfig, scene: Scene, transform: ColorTransform | None = None,
        photometric: Photometric | None = None, seed: int = 0,
    ):  # fmt: skip
        check_geometry(config.geometry, scene)
        super().__init__(config, scene, transform, photometric, seed)
        self.total_steps = config.steps
        space = space_of(scene, config.geometry)
        space.divide(space.longest / config.samples)
        sizes = config.levels, config.features, 1 << config.log2_entries, config.coarsest, config.finest
        with seeded(seed):
            self.field = HashField(
                space,
                HashGrid(*sizes),
                cells=config.cells,
                channels=self.channels,
                width=config.width,
                degrees=config.degrees,
                alpha_thre=config.threshold,
                free_below=config.free_below,
            )

    # Training.

    def field_optimizers(self) -> dict[str, Optimizer]:
        config, field = self.config, self.field
        networks = [*field.density.parameters(), *field.color.parameters()]
        # The paper's: rows of a table get gradients of very different sizes, and seldom.
        return {
            "grid": GridAdam([field.hash_grid.table], config.lr_grid, (0.9, 0.99), eps=1e-15),
            "mlp": Adam(networks, config.lr_mlp, (0.9, 0.99), eps=1e-15, weight_decay=1e-6, fused=True),
        }

    def field_schedule(self) -> Schedule:
        return exponential(self.config.lr_final, self.config.steps)

    def on_fit_start(self) -> None:
        super().on_fit_start()
        self.field.occupy(self.field.occupancy)
        self.renew_pool()

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        if self.between_steps:
            self.look_for_free_space(self.global_step)
        super().on_train_batch_start(batch, batch_idx)

    def look_for_free_space(self, step: int) -> None:
        """Update the occupancy before a step, when it is due."""
        config = self.config
        times, rest = divmod(step - config.occupancy_first, config.occupancy_every)
        if times < 0 or rest:
            return
        share = config.occupancy_share if times else 1.0
        draws = Draws(self.seed, step, self.device, stream="occupancy")  # the same in all processes
        self.field.update_occupancy(draws, share)
        if self.settles and times >= SETTLING_UPDATES and times.bit_count() == 1:
            shown = self.shown_pixels()
            some = shown[draws.integers(len(shown), FOREGROUND_PIXELS)] if len(shown) else shown
            self.field.free_permanently(config.free_for_good, self.training_rays(some), self.hull)
            self.renew_pool()

    def shown_pixels(self) -> Tensor:
        """``[S]``: flat indices of the training pixels of the foreground."""
        shown = self.pixels[:, 3] > 0
        if self.unmasked is not None:
            shown &= torch.zeros_like(shown).index_fill_(0, self.unmasked.long(), True)
        return shown.nonzero().squeeze(1)

    @property
    def settles(self) -> bool:
        """Whether cells may become permanently free: around an object with alpha, unless only renderings get random
        backgrounds; there, empty space has to become opaque."""
        scene = self.scene
        straight = self.config.geometry == "bounded"
        return self.config.free_for_good > 0 and straight and scene.train.has_alpha and scene.background != "random"

    def hull(self, points: Tensor) -> Tensor:
        """``[M]`` boolean: whether the pictures' alpha leaves room for the object in cells round points ``[M, 3]``."""
        return visual_hull(points, self.scene.train, (0.5 / self.field.grid.scale).norm().item())

    def renew_pool(self) -> None:
        """Draw training pixels from the rays that may meet an occupied cell, once cells are permanently free."""
        if self.settles and not self.field.met.all():
            self.draw_those(self.field.hits)

    def world_box(self) -> Tensor:
        return self.pictured_field.around if self.config.geometry == "bounded" else super().world_box()
