"""NeRF: two MLPs, the second one where the first found something (Mildenhall et al., ECCV 2020)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Adam, Optimizer
from torch.profiler import record_function

from ctm_plugin.backbones.nerf_field import NeRFField
from ctm_plugin.backbones.radiance import RadianceBackbone, RayRendering, check_geometry
from ctm_plugin.backbones.settings import NeRFConfig
from ctm_plugin.backbones.spaces import space_of
from ctm_plugin.color.photometric import Photometric
from ctm_plugin.color.transform import ColorTransform
from ctm_plugin.draws import Draws, seeded
from ctm_plugin.optim.schedules import Schedule, exponential
from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.sampling import importance, stratified
from ctm_plugin.rays.volume import table_weights
from ctm_plugin.scene.views import Scene

EVAL_BYTES = 200e6
"""Memory in bytes that rendering a chunk of rays may take."""


class NeRF(RadianceBackbone):
    """NeRF: a coarse and a fine network, trained in a transform's space; both renderings take the loss.

    Args:
        config: sizes, steps, rates.
        scene: its geometry must be the configuration's.
        transform, photometric, seed: see :class:`RadianceBackbone`.
    """

    Config = NeRFConfig

    def __init__(
        self, config: NeRFConfig, scene: Scene, transform: ColorTransform | None = None,
        photometric: Photometric | None = None, seed: int = 0,
    ):  # fmt: skip
        check_geometry(config.geometry, scene)
        super().__init__(scene, config.rays, transform, photometric, seed)
        self.config = config
        self.total_steps = config.steps
        self.space = space_of(scene, "forward" if config.geometry == "forward" else "bounded")
        # Lengths are the world's. On lines through NDC's eye a unit of t is 2 long.
        self.space.measure = 0.5 if config.geometry == "forward" else 1.0
        samples = config.coarse_samples + config.fine_samples
        # Three layers of a chunk at a time.
        self.eval_chunk = max(1, int(EVAL_BYTES / (samples * 3 * 4 * config.width)))
        sizes = (config.width, config.depth, config.skip)
        with seeded(seed):
            self.coarse = NeRFField(self.channels, *sizes)
            self.fine = NeRFField(self.channels, *sizes)

    # Training.

    def field_optimizers(self) -> dict[str, Optimizer]:
        return {"field": Adam([*self.coarse.parameters(), *self.fine.parameters()], self.config.lr, fused=True)}

    def field_schedule(self) -> Schedule:
        return exponential(0.1, self.config.lr_decay_steps)

    def color_biases(self) -> list[Tensor]:
        return [self.coarse.color.bias, self.fine.color.bias] if self.config.start == "mean" else []

    def on_fit_start(self) -> None:
        super().on_fit_start()
        self._crop()

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        if self.pool is not None:
            self._crop()
        super().on_train_batch_start(batch, batch_idx)

    def _crop(self) -> None:
        """Train on the pictures' middles at first: a network that learns background first may stay empty."""
        if self.global_step >= self.config.crop_steps:
            self.pool = None
        elif self.pool is None:
            middle = self.middle_pixels()
            self.pool = middle if len(middle) else None

    def middle_pixels(self) -> Tensor:
        """Find flat indices ``[M]`` of training pixels in the middle of each picture, half its sides, masks aside."""
        views = self.scene.train
        rows, columns = (torch.arange(side // 4, side - side // 4) for side in (views.height, views.width))
        view = torch.arange(len(views))[:, None, None]
        pixel = ((view * views.height + rows[:, None]) * views.width + columns).flatten()
        pixel = pixel if views.mask is None else pixel[views.mask.flatten()[pixel]]
        return pixel.int().to(self.device)

    # Rendering.

    def render(self, rays: Rays, background: Tensor, draws: Draws | None) -> RayRendering:
        config, count = self.config, len(rays.origins)
        lines = self.space.local(rays)
        jitter = None if draws is None else draws.uniform(count, config.coarse_samples)
        t = self._spread(stratified(count, config.coarse_samples, jitter, self.device))
        coarse, weights, _ = self._march(self.coarse, lines, rays.directions, t, background, draws)
        with torch.no_grad(), record_function("ctm/samples"):
            # The first and the last sample stand for the ends of the ray: neither has a bin.
            middles = (t[:, 1:] + t[:, :-1]) / 2
            jitter = None if draws is None else draws.uniform(count, config.fine_samples)
            u = stratified(count, config.fine_samples, jitter, self.device)
            t = torch.cat([t, importance(middles, weights[:, 1:-1], u)], dim=1).sort(dim=1).values
        fine, weights, transmittance = self._march(self.fine, lines, rays.directions, t, background, draws)
        with torch.no_grad():
            depth = (weights * self.space.distances(rays, t, (slice(None), None))).sum(
                1
            ) + transmittance * self.scene.far
        return RayRendering((coarse, fine), opacity=1 - transmittance.detach(), depth=depth)

    def query(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        local, unit = self.space.place(points)
        density, latent = self.fine(local[:, None], directions)
        return density.squeeze(1) * unit, latent.squeeze(1)

    def _spread(self, s: Tensor) -> Tensor:
        """Map shares ``[R, S]`` of the way from near to far to distances along rays, or to NDC's ray parameter."""
        near, far = self.space.near, self.space.far
        if self.config.geometry == "unbounded":
            return 1 / ((1 - s) / near + s / far)
        return near + (far - near) * s

    def _march(
        self, field: nn.Module, lines: Rays, directions: Tensor, t: Tensor, background: Tensor, draws: Draws | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Render rays from samples at ``t`` ``[R, S]``: latent ``[R, k]``, weights ``[R, S]``, transmittance ``[R]``.

        The last sample stands for all that lies behind it.
        """
        noise = None
        if draws is not None and self.config.density_noise:
            noise = self.config.density_noise * draws.normal(*t.shape)
        points = lines.origins[:, None] + t[..., None] * lines.directions[:, None]
        density, latent = field(points, directions, noise)
        length = torch.cat([t.diff(dim=1), torch.full_like(t[:, :1], 1e10)], dim=1)
        weights, transmittance = table_weights(density * length * lines.directions.norm(dim=1, keepdim=True))
        # Sums, not products of matrices: those autocast would round.
        latent = (weights[..., None] * latent).sum(1) + transmittance[:, None] * background
        return latent, weights, transmittance
