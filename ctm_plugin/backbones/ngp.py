"""NGP: a multiresolution hash grid, in a box, in NDC or in all of space (Müller et al., SIGGRAPH 2022)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.optim import Adam, Optimizer

from ctm_plugin.backbones.hashed import HashField
from ctm_plugin.backbones.occupied import OccupiedBackbone
from ctm_plugin.backbones.radiance import STARTS, check_geometry
from ctm_plugin.backbones.spaces import space_of
from ctm_plugin.color.photometric import Photometric
from ctm_plugin.draws import Draws, seeded
from ctm_plugin.errors import ConfigError
from ctm_plugin.optim.grid_adam import GridAdam
from ctm_plugin.optim.named_optimizers import Schedule, exponential
from ctm_plugin.rays.hash_grid import HashGrid
from ctm_plugin.scene.frustum import visual_hull
from ctm_plugin.scene.views import GEOMETRIES, Scene
from ctm_plugin.settings.build import by_geometry, setting
from ctm_plugin.settings.check import check_choice, check_integer, check_least, check_square

SETTLED = 16
"""Looks at the occupancy before what is free is so for good."""
SHOWN = 1 << 16
"""Of pixels that show something, which have to meet something then."""


@dataclass(frozen=True, kw_only=True)
class NGPConfig:
    """The defaults are the paper's, where it has them.

    In ``unbounded`` scenes, what stands among the cameras is resolved finely, and what lies behind it more coarsely
    with its distance. ``rays_per_pixel=1`` makes pictures in a quarter of the time. On a CPU, tables of 2^16 rows stay
    in a core's cache, and other ``features`` than 2 are far slower.
    """

    geometry: str = setting(
        "bounded",
        "bounded: a box of the world; forward: NDC; unbounded: all of space, contracted into a ball",
        composed="${oc.select:dataset.geometry,bounded}",
    )
    steps: int = setting(20_000, "training steps")
    rays: int = setting(4096, "rays a step, over all processes")
    samples: int = setting(1024, "samples on a ray through the whole space, those in empty space included")
    levels: int = setting(16, "levels of the hash grid")
    features: int = setting(2, "numbers that each vertex of a level holds; 2 has a fast loop on a CPU")
    log2_entries: int = setting(19, "base-2 logarithm of the largest number of rows of a level's table")
    coarsest: int = setting(16, "cells a side of the coarsest level")
    finest: int = setting(2048, "cells a side of the finest level")
    width: int = setting(64, "width of both networks' hidden layers")
    degrees: int = setting(
        4, "degrees of the viewing direction's spherical harmonics; 1: colours do not depend on the direction"
    )
    threshold: float = setting(1e-4, "samples with less alpha or less weight are skipped")
    cells: int = setting(128**3, "cells of the occupancy grid, which says where space is empty")
    free_below: float = setting(
        0.01, "cells of the occupancy grid are empty below this alpha, if they are also below the mean alpha"
    )
    occupancy_first: int = setting(256, "step at which empty space is first looked for")
    occupancy_every: int = setting(16, "steps between later looks for empty space")
    occupancy_share: float = setting(
        0.25, "share of the occupancy grid's cells that each look visits, and as many again of those not empty"
    )
    free_for_good: float = setting(
        0.0,
        "alpha below which cells stay empty for good after 16, 32, 64, ... looks, if their neighbours are below "
        "it; only with alpha",
    )
    start: str = setting("mean", "colour of the field before the first step: mean (the scene's mean colour) or grey")
    lr_grid: float = setting(1e-2, "learning rate of the hash grid")
    lr_mlp: float = setting(1e-2, "learning rate of the networks")
    lr_final: float = setting(0.1, "factor that learning rates fall to by the last step")
    averaged: int = setting(
        0,
        "pictures are rendered with a running mean of the parameters over about this many steps; 0: with the last ones",
    )
    rays_per_pixel: int = setting(
        1, "rays a pixel of rendered pictures, a square number; they cover the middle quarter of the pixel"
    )
    relative: bool = setting(
        True,
        "divide the colour loss by 12 times the variance of the scene's colours, as regularisers do not depend on "
        "the light",
    )
    distortion: float = by_geometry(
        0.0, 0.01, "weight of the distortion loss, which gathers each ray's weight in one place"
    )
    occlusion: float = setting(0.0, "weight of the loss on density close to the cameras")

    def __post_init__(self) -> None:
        check_choice("backbone.geometry", self.geometry, GEOMETRIES)
        check_choice("backbone.start", self.start, STARTS)
        check_square("backbone.rays_per_pixel", self.rays_per_pixel)
        check_integer("backbone.degrees", self.degrees, 1, 8)
        check_integer("backbone.log2_entries", self.log2_entries, 4, 28)
        least = {
            "coarsest": 2,
            "cells": 8,
            "samples": 2,
            "free_for_good": 0,
            "distortion": 0,
            "occlusion": 0,
            "averaged": 0,
        }
        for name, value in vars(self).items():
            if name not in ("geometry", "start", "relative", "degrees", "log2_entries"):
                check_least(f"backbone.{name}", value, least.get(name))
        if self.finest < self.coarsest:
            raise ConfigError("backbone.finest", self.finest, f"at least backbone.coarsest, {self.coarsest}")
        if self.threshold >= 1:
            raise ConfigError("backbone.threshold", self.threshold, "a number in (0, 1)")
        for name in ("free_below", "free_for_good", "occupancy_share"):
            if getattr(self, name) > 1:
                expected = f"a number in {'[' if name in least else '('}0, 1]"
                raise ConfigError(f"backbone.{name}", getattr(self, name), expected)


class NGP(OccupiedBackbone):
    """NGP: a multiresolution hash grid, trained in a transform's space.

    Args:
        config: sizes, steps, rates.
        scene: its geometry must be the configuration's.
        channels, photometric, seed: see :class:`~ctm_plugin.backbones.radiance.RadianceBackbone`.
    """

    Config = NGPConfig
    eval_chunk = 4096

    def __init__(
        self, config: NGPConfig, scene: Scene, channels: int = 3, photometric: Photometric | None = None, seed: int = 0
    ):
        check_geometry(config.geometry, scene)
        super().__init__(config, scene, channels, photometric, seed)
        self.total_steps = config.steps
        space = space_of(scene, config.geometry)
        space.divide(space.longest / config.samples)
        sizes = config.levels, config.features, 1 << config.log2_entries, config.coarsest, config.finest
        with seeded(seed):
            self.field = HashField(
                space,
                HashGrid(*sizes),
                cells=config.cells,
                channels=channels,
                width=config.width,
                degrees=config.degrees,
                threshold=config.threshold,
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
        self.field.occupy(self.field.occupancy)
        self.renew_pool()

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        if self.between_steps:
            self.look_for_free_space(self.global_step)
        super().on_train_batch_start(batch, batch_idx)

    def look_for_free_space(self, step: int) -> None:
        """Look for it before a step, when it is time."""
        config = self.config
        times, rest = divmod(step - config.occupancy_first, config.occupancy_every)
        if times < 0 or rest:
            return
        share = config.occupancy_share if times else 1.0
        # The same in all processes, and none that a batch is drawn by.
        draws = Draws(self.seed, -2 - step, self.device)
        self.field.update_occupancy(draws, share)
        if self.settles and times >= SETTLED and times.bit_count() == 1:
            shown = self.shown_pixels()
            some = shown[draws.integers(len(shown), SHOWN)] if len(shown) else shown
            self.field.settle(config.free_for_good, self.training_rays(some), self.hull)
            self.renew_pool()

    def shown_pixels(self) -> Tensor:
        """``[S]``: flat indices of the training pixels that show something."""
        shown = self.pixels[:, 3] > 0
        if self.unmasked is not None:
            shown &= torch.zeros_like(shown).index_fill_(0, self.unmasked.long(), True)
        return shown.nonzero().squeeze(1)

    @property
    def settles(self) -> bool:
        """Whether cells become free for good: around an object. Not where only renderings get random backgrounds:
        there, empty space has to become opaque.
        """
        scene = self.scene
        straight = self.config.geometry == "bounded"
        return self.config.free_for_good > 0 and straight and scene.train.has_alpha and scene.background != "random"

    def hull(self, points: Tensor) -> Tensor:
        """``[M]`` boolean: whether the pictures' alpha leaves room for the object in cells round points ``[M, 3]``."""
        return visual_hull(points, self.scene.train, (0.5 / self.field.grid.scale).norm().item())

    def renew_pool(self) -> None:
        """Draw training pixels from the rays that may meet something, once cells are free for good."""
        if self.settles and not self.field.met.all():
            self.draw_those(self.field.hits)

    def world_box(self) -> Tensor:
        return self.pictured_field.around if self.config.geometry == "bounded" else super().world_box()
