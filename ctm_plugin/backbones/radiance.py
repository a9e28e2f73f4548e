"""Backbones that render a posed scene: what NeRF, DVGO and their like have in common."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from ctm_plugin.backbones.base import Backbone, Batch, Rendering
from ctm_plugin.color.loss import Photometric
from ctm_plugin.data.scene import Scene, Views, composite
from ctm_plugin.draws import Draws
from ctm_plugin.rays.cameras import Rays, pixel_rays

STARTS = ("mean", "grey")
"""What a field's colours may be before its first step: the scene's mean, or the middle of the latent cube."""


@dataclass
class RayBatch(Batch):
    """Rays with their colours.

    Attributes:
        rays: R rays.
        background: ``[R, k]`` or ``[1, k]``, the latent behind the scene.
    """

    rays: Rays = field(kw_only=True)
    background: Tensor = field(kw_only=True)


@dataclass
class RayRendering(Rendering):
    """Latents with geometry.

    Attributes:
        opacity: ``[R]``, the sum of the weights along each ray.
        depth: ``[R]``, expected distance along the ray; light that nothing stops counts as stopped at ``far``.
    """

    opacity: Tensor = field(kw_only=True)
    depth: Tensor = field(kw_only=True)


class RadianceBackbone(Backbone):
    """Draws rays of a :class:`Scene` and puts the scene's background behind them.

    A subclass gives ``render``, and of what :class:`Backbone` asks for ``total_steps`` and ``field_optimizers``.

    Args:
        scene: training and test views.
        rays: rays a step, over all processes.
        channels, photometric, seed: see :class:`Backbone`.
    """

    Scene = Scene
    eval_chunk = 8192

    def __init__(
        self, scene: Scene, rays: int, channels: int = 3, photometric: Photometric | None = None, seed: int = 0
    ):
        super().__init__(channels, photometric, seed)
        self.scene = scene
        self.rays = rays
        views = scene.train
        self.register_buffer("pixels", views.images.flatten(0, 2), persistent=False)
        self.register_buffer("c2w", views.c2w, persistent=False)
        self.register_buffer("intrinsics", views.intrinsics, persistent=False)
        self.register_buffer("distortion", views.distortion, persistent=False)
        self.register_buffer("pool", None, persistent=False)

    def render(self, rays: Rays, background: Tensor, draws: Draws | None) -> RayRendering:
        """Volume rendering in the latent space.

        Args:
            rays: R rays.
            background: ``[R, k]`` or ``[1, k]`` latent, seen where light passes the scene.
            draws: random numbers in training, ``None`` in evaluation, which must be deterministic.
        """
        raise NotImplementedError

    def draw(self, draws: Draws) -> RayBatch:
        rows = self.rays // draws.world
        pixel = draws.integers(len(self.pixels) if self.pool is None else len(self.pool), rows)
        if self.pool is not None:
            pixel = self.pool[pixel].long()
        rays = self.training_rays(pixel)
        behind, latent_behind = self._backgrounds(draws, rows)
        return RayBatch(composite(self.pixels[pixel], behind), rays=rays, background=latent_behind)

    def scene_colors(self, draws: Draws, count: int) -> Tensor:
        pixel = draws.integers(len(self.pixels), count)
        return composite(self.pixels[pixel], self.constant_background())

    def training_rays(self, pixel: Tensor) -> Rays:
        """Rays of training pixels, by flat index over all views."""
        views = self.scene.train
        return pixel_rays(self.c2w, self.intrinsics, views.height, views.width, pixel, self.distortion)

    @torch.no_grad()
    def _backgrounds(self, draws: Draws, rows: int) -> tuple[Tensor, Tensor]:
        """The colour under the training pixels and the latent under their renderings."""
        kind, level = self.scene.background, self.scene.random_level
        if kind not in ("random", "random_matched"):
            color = self.constant_background()
            return color, self.transform.encode(color)
        # Uniform in the latent space, or colours as bright as the scene asks for.
        drawn = draws.uniform(rows, self.channels) if level is None else level * draws.uniform(rows, 3)
        if kind == "random":
            return torch.zeros(1, 3, device=self.device), drawn if level is None else self.transform.encode(drawn)
        random = self.transform.decode(drawn) if level is None else drawn
        # A quarter of the rays sees the background of evaluation, which the others would never meet.
        color = torch.where(torch.arange(rows, device=self.device)[:, None] % 4 > 0, random, self.constant_background())
        return color, self.transform.encode(color)

    def constant_background(self) -> Tensor:
        """``[1, 3]``: the colour behind the scene in evaluation: white for ``white``, else black."""
        return torch.full((1, 3), float(self.scene.background == "white"), device=self.device)

    def predict(self, batch: RayBatch, draws: Draws) -> RayRendering:
        return self.render(batch.rays, batch.background, draws)

    @torch.no_grad()
    def render_rays(self, rays: Rays) -> RayRendering:
        """Render any number of rays in chunks, without randomness, over the constant background."""
        background = self.transform.encode(self.constant_background())
        count = len(rays.origins)
        chunks = [
            self.render(rays[start : start + self.eval_chunk], background, None)
            for start in range(0, count, self.eval_chunk)
        ]
        latent = torch.cat([chunk.latent.float() for chunk in chunks])
        opacity = torch.cat([chunk.opacity for chunk in chunks])
        depth = torch.cat([chunk.depth for chunk in chunks])
        return RayRendering((latent,), opacity=opacity, depth=depth)

    def render_view(self, views: Views, index: int, every: int = 1) -> dict[str, Tensor]:
        """One view: ``rgb`` ``[H, W, 3]``, ``latent`` ``[H, W, k]``, ``depth`` and ``opacity`` ``[H, W]``.

        Args:
            views, index: which one.
            every: of rows and columns, the first one included.
        """
        height, width = views.height, views.width
        pixel = torch.arange(height * width, device=self.device).view(height, width)[::every, ::every]
        c2w, intrinsics, distortion = (
            None if of_all is None else of_all[index : index + 1].to(self.device)
            for of_all in (views.c2w, views.intrinsics, views.distortion)
        )
        out = self.render_rays(pixel_rays(c2w, intrinsics, height, width, pixel.flatten(), distortion))
        shaped = {"rgb": self.decode(out.latent), "latent": out.latent, "depth": out.depth, "opacity": out.opacity}
        return {name: value.unflatten(0, pixel.shape) for name, value in shaped.items()}
