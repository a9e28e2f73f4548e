"""An exposure a picture, and a small grid of affine maps over place and brightness."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from ctm_controls.affine import inverted, mixed
from ctm_plugin.appearance.exposure import Exposure, PixelPlaces
from ctm_plugin.appearance.settings import ExposureConfig
from ctm_plugin.color.srgb import srgb_to_linear
from ctm_plugin.rays.grid import VoxelGrid, lookup
from ctm_plugin.scene.views import Views, bright_level
from ctm_plugin.settings.setting import setting

REC601_LUMA = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in the luma of sRGB values (ITU-R BT.601)."""


@dataclass(frozen=True, kw_only=True)
class BilateralConfig(ExposureConfig):
    """How fine the grids are, and how smooth."""

    across: int = setting(16, "columns, and rows, of each picture's grid", least=2, most=256)
    levels: int = setting(8, "levels of brightness in each picture's grid", least=2, most=256)
    lr_grid: float = setting(2e-3, "learning rate of the grids", above=0)
    smooth: float = setting(
        10.0, "weight of the grids' total variation: more makes neighbouring maps more alike", least=0
    )


class Bilateral(Exposure):
    """An exposure of each picture's own and a grid of affine maps over place and brightness: vignettes, tone curves.

    ``y = g_i (M x + L t)`` in picture i, ``[M t]`` out of its grid at (brightness, y, x), trilinearly: that of
    bilateral guided radiance fields (Wang et al., SIGGRAPH 2024), with two differences. Maps are of linear light, and
    brightness is the luminance of the rendered sRGB over the level below which 99 % of the training colours lie, whose
    light is L, so that a dark scene has all of the grid and offsets of its own size. Vertices are
    ``[1 0] + B_i - mean_j B_j``: the pictures' mean is the identity everywhere whatever is learned. ``smooth`` weighs
    the total variation: the mean squared difference of neighbours, added up over the three sides.
    """

    Config = BilateralConfig

    def __init__(self, config: BilateralConfig, views: Views):
        super().__init__(config, views)
        self.sides = (config.levels, config.across, config.across)
        # One grid holds all pictures' grids, one after another: a whole level lies only on its own picture's vertices.
        shape = (len(views) * config.levels, config.across, config.across)
        self.stack = VoxelGrid(torch.stack([torch.zeros(3), torch.tensor(shape, dtype=torch.float32) - 1]), shape)
        self.grid = nn.Parameter(torch.zeros(len(views), self.stack.count // len(views), 12))
        level = torch.tensor(max(bright_level(views), 1 / 255))
        self.register_buffer("luminance", torch.tensor(REC601_LUMA) / level, persistent=False)
        self.register_buffer("light", srgb_to_linear(level), persistent=False)
        self.register_buffer("last", torch.tensor(self.sides, dtype=torch.float32) - 1, persistent=False)

    def grids(self) -> Float[Tensor, "n v 12"]:
        """What all pictures' vertices add to the identity; the pictures' mean is 0."""
        return self.grid - self.grid.mean(0)

    def maps(self, place: PixelPlaces) -> tuple[Float[Tensor, "r 3 3"], Float[Tensor, "r 3"]]:
        """The matrices and offsets of pixels."""
        shade = (place.rendered * self.luminance).sum(-1).clamp(0, 1)
        points = torch.stack([shade, place.at[:, 1], place.at[:, 0]], dim=-1) * self.last
        points[:, 0] += place.view * self.sides[0]
        rows = lookup(self.grids().flatten(0, 1), self.stack.corners(points)).unflatten(1, (3, 4))
        return rows[..., :3] + torch.eye(3, device=rows.device), rows[..., 3] * self.light

    def forward(self, light: Float[Tensor, "r 3"], place: PixelPlaces) -> Float[Tensor, "r 3"]:
        matrices, offsets = self.maps(place)
        return super().forward(mixed(matrices, light) + offsets, place)

    def undone(self, light: Float[Tensor, "r 3"], place: PixelPlaces) -> Float[Tensor, "r 3"]:
        matrices, offsets = self.maps(place)
        return mixed(inverted(matrices), super().undone(light, place) - offsets)

    def regularisers(self) -> dict[str, Tensor]:
        if not self.config.smooth:
            return {}
        grids = self.grid.unflatten(1, self.sides)
        sides = [(grids.narrow(side, 1, n - 1), grids.narrow(side, 0, n - 1)) for side, n in enumerate(self.sides, 1)]
        return {"smooth": self.config.smooth * sum(F.mse_loss(*neighbours) for neighbours in sides)}

    def groups(self) -> list[dict]:
        return [*super().groups(), {"params": [self.grid], "lr": self.config.lr_grid, "name": "grid"}]
