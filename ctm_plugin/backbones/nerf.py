"""NeRF: two MLPs, the second one where the first found something (Mildenhall et al., ECCV 2020)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Adam, Optimizer
from torch.profiler import record_function

from ctm_plugin.backbones.nerf_field import NeRFField
from ctm_plugin.backbones.radiance import STARTS, RadianceBackbone, RayRendering, check_geometry
from ctm_plugin.backbones.spaces import space_of
from ctm_plugin.color.photometric import Photometric
from ctm_plugin.draws import Draws, seeded
from ctm_plugin.errors import ConfigError
from ctm_plugin.optim.named_optimizers import Schedule, exponential
from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.sampling import importance, stratified
from ctm_plugin.rays.volume import table_weights
from ctm_plugin.scene.views import Scene
from ctm_plugin.settings.build import by_geometry, setting
from ctm_plugin.settings.check import check_choice, check_least

GEOMETRIES = ("bounded", "forward", "unbounded")
EVAL_BYTES = 200e6
"""Memory that rendering a chunk of rays may take."""


@dataclass(frozen=True, kw_only=True)
class NeRFConfig:
    """The defaults are the paper's (NeRF's own for Synthetic-NeRF).

    A run that ends as an empty scene has ``converged`` false in its ``metrics.json``.
    """

    geometry: str = setting(
        "bounded",
        "how samples are spaced along rays: bounded (evenly in distance), forward (evenly in NDC) or unbounded "
        "(evenly in inverse distance)",
        composed="${oc.select:dataset.geometry,bounded}",
    )
    steps: int = setting(100_000, "training steps")
    rays: int = setting(1024, "rays a step, over all processes")
    coarse_samples: int = setting(64, "samples a ray of the coarse network")
    fine_samples: int = setting(128, "further samples a ray of the fine network, which also gets the coarse network's")
    width: int = setting(256, "width of both networks' hidden layers")
    depth: int = setting(8, "number of both networks' hidden layers")
    skip: int = setting(5, "number, from 0, of the layer that gets the embedded position again")
    lr: float = setting(5e-4, "learning rate")
    lr_decay_steps: int = by_geometry(500_000, 250_000, "steps in which the learning rate falls to a tenth")
    crop_steps: int = by_geometry(
        500, 0, "first steps, in which only the middle half of each picture's width and height is trained on"
    )
    density_noise: float = by_geometry(
        0.0, 1.0, "standard deviation of the noise that is added to densities in training"
    )
    start: str = setting(
        "mean", "colour of the field before the first step: mean (the scene's mean colour) or grey (as in NeRF)"
    )

    def __post_init__(self) -> None:
        check_choice("backbone.geometry", self.geometry, GEOMETRIES)
        check_choice("backbone.start", self.start, STARTS)
        least = {"coarse_samples": 3, "width": 2, "depth": 2, "crop_steps": 0, "density_noise": 0}
        for name, value in vars(self).items():
            if name in ("geometry", "start"):
                continue
            check_least(f"backbone.{name}", value, least.get(name))
        if self.skip >= self.depth:
            raise ConfigError("backbone.skip", self.skip, f"a layer from 1 to {self.depth - 1}")


class NeRF(RadianceBackbone):
    """NeRF: a coarse and a fine network, trained in a transform's space; both renderings take the loss.

    Args:
        config: sizes, steps, rates.
        scene: its geometry must be the configuration's.
        channels, photometric, seed: see :class:`RadianceBackbone`.
    """

    Config = NeRFConfig

    def __init__(
        self, config: NeRFConfig, scene: Scene, channels: int = 3, photometric: Photometric | None = None, seed: int = 0
    ):
        check_geometry(config.geometry, scene)
        super().__init__(scene, config.rays, channels, photometric, seed)
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
            self.coarse = NeRFField(channels, *sizes)
            self.fine = NeRFField(channels, *sizes)

    # Training.

    def field_optimizers(self) -> dict[str, Optimizer]:
        return {"field": Adam([*self.coarse.parameters(), *self.fine.parameters()], self.config.lr, fused=True)}

    def field_schedule(self) -> Schedule:
        return exponential(0.1, self.config.lr_decay_steps)

    def color_biases(self) -> list[Tensor]:
        return [self.coarse.color.bias, self.fine.color.bias] if self.config.start == "mean" else []

    def on_fit_start(self) -> None:
        self._crop()

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        if self.pool is not None:
            self._crop()
        super().on_train_batch_start(batch, batch_idx)

    def _crop(self) -> None:
        """Most of a picture may be background, and a network that learns nothing else first may stay empty."""
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
        """Map [0, 1] onto the rays: ``[R, S]`` to distances, or to NDC's own parameter."""
        near, far = self.space.near, self.space.far
        if self.config.geometry == "unbounded":
            return 1 / ((1 - s) / near + s / far)
        return near + (far - near) * s

    def _march(
        self, field: nn.Module, lines: Rays, directions: Tensor, t: Tensor, background: Tensor, draws: Draws | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Latent ``[R, k]``, weights ``[R, S]`` and transmittance ``[R]`` of samples at ``t`` ``[R, S]``.

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
