"""A backbone of another package: one MLP from position to density and latent, equal steps along each ray."""

from dataclasses import dataclass

import torch
from torch import nn

from ctm_plugin.backbones.radiance import RadianceBackbone, RayRendering
from ctm_plugin.rays.sampling import march
from ctm_plugin.rays.volume import segment_sums, volume_weights


@dataclass(frozen=True, kw_only=True)
class TinyConfig:
    """What ``backbone.KEY=value`` can set."""

    rays: int = 512
    steps: int = 500
    samples: int = 32
    width: int = 64
    frequencies: int = 6
    lr: float = 2e-3


class Tiny(RadianceBackbone):
    Config = TinyConfig

    def __init__(self, config, scene, transform=None, photometric=None, seed=0):
        super().__init__(scene, config.rays, transform, photometric, seed)
        self.config, self.total_steps = config, config.steps
        size = 3 * (1 + 2 * config.frequencies)
        hidden = [nn.Linear(size, config.width), nn.ReLU(), nn.Linear(config.width, config.width), nn.ReLU()]
        self.mlp = nn.Sequential(*hidden, nn.Linear(config.width, self.channels + 1))

    def render(self, rays, background, draws):
        near, far, n_rays = self.scene.near, self.scene.far, len(rays.origins)
        step = (far - near) / self.config.samples
        offset = 0.5 if draws is None else draws.uniform(n_rays, 1).squeeze(1)
        ends = torch.full((2, n_rays), near, device=self.device)
        ends[1] = far
        t, ray_index = march(*ends, step, offset)
        points = rays.points(t, ray_index)
        angles = torch.cat([points * 2**p for p in range(self.config.frequencies)], dim=-1)
        raw = self.mlp(torch.cat([points, angles.sin(), angles.cos()], dim=-1)).float()
        weights, transmittance = volume_weights(nn.functional.softplus(raw[:, 0]) * step, ray_index, n_rays)
        latent = segment_sums(weights[:, None] * raw[:, 1:].sigmoid(), ray_index, n_rays)
        latent = latent + transmittance[:, None] * background
        depth = segment_sums(weights * t, ray_index, n_rays) + transmittance * far
        return RayRendering((latent,), opacity=1 - transmittance, depth=depth.detach())

    def field_optimizers(self):
        return {"field": torch.optim.Adam(self.mlp.parameters(), self.config.lr)}
