"""Another package: what it offers stands in its entry points, in the folder beside this file."""

import math
from dataclasses import dataclass

import torch
from torch import nn

from ctm_plugin.backbones.radiance import RadianceBackbone, RayRendering
from ctm_plugin.color.transform import ColorTransform
from ctm_plugin.metrics.table import Metric
from ctm_plugin.settings.setting import Settings, setting


@dataclass(frozen=True, kw_only=True)
class PowerConfig(Settings, section="color_space"):
    middle: float = setting(0.5, "latent of the median", above=0, below=1)


class Power(ColorTransform):
    """The power of each channel that takes the scene's mean to ``middle``."""

    Config = PowerConfig

    def __init__(self, config):
        super().__init__(config)
        self.register_buffer("power", torch.ones(3))

    def begin(self, rgb):
        self.power = math.log(self.config.middle) / rgb.mean(0).log()

    def encode(self, rgb):
        return rgb.clamp(min=1e-6) ** self.power

    def decode(self, latent):
        return latent.clamp(min=1e-6) ** (1 / self.power)


@dataclass(frozen=True, kw_only=True)
class GlowConfig:
    rays: int = 64
    steps: int = 4


class Glow(RadianceBackbone):
    """Light from all around: a latent for each direction, no density."""

    Config = GlowConfig

    def __init__(self, config, scene, transform=None, photometric=None, seed=0):
        super().__init__(scene, config.rays, transform, photometric, seed)
        self.total_steps = config.steps
        self.layer = nn.Linear(3, self.channels)

    def render(self, rays, background, draws):
        depth = torch.full_like(rays.origins[:, 0], self.scene.far)
        return RayRendering((self.layer(rays.directions).sigmoid(),), opacity=torch.ones_like(depth), depth=depth)

    def field_optimizers(self):
        return {"field": torch.optim.Adam(self.layer.parameters(), 1e-2)}


WORST = Metric(
    label="worst pixel",
    about="mean over views of the largest error of a channel",
    higher=False,
    view=lambda view: float((view.prediction - view.target).abs().max()),
)
