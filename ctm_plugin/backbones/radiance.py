"""Backbones that render a posed scene by rays: what NeRF, DVGO and their like have in common."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from ctm_plugin.backbones.base import Batch, Rendering
from ctm_plugin.backbones.posed import PosedBackbone
from ctm_plugin.color.photometric import Photometric
from ctm_plugin.color.transform import ColorTransform
from ctm_plugin.draws import Draws, FixedDraws
from ctm_plugin.errors import ConfigError
from ctm_plugin.gpu.room import times_a_chunk
from ctm_plugin.rays.cameras import Rays, pixel_rays, within_pixel
from ctm_plugin.scene.views import Scene, Views, composite

POOL_CHUNK = 1 << 16
"""Rays marched at once when the pool of training pixels is drawn: some 200 MB."""


def check_geometry(geometry: str, scene: Scene) -> None:
    """Refuse a geometry that is not the scene's, and unbounded scenes that begin at the camera.

    Raises:
        ConfigError: one of the two.
    """
    if geometry != scene.geometry:
        raise ConfigError("backbone.geometry", geometry, f"{scene.geometry}, as {scene.name} is")
    if geometry == "unbounded" and not scene.near > 0:
        raise ConfigError("dataset.near", scene.near, "more than 0 for dataset.geometry=unbounded")


@dataclass
class RayBatch(Batch):
    """A training batch of rays with their colours.

    Attributes:
        rays: R rays.
        pixel: ``[R]``, flat indices over all training views.
        background: ``[R, k]`` or ``[1, k]``, the latent behind the scene.
    """

    rays: Rays = field(kw_only=True)
    pixel: Tensor = field(kw_only=True)
    background: Tensor = field(kw_only=True)


@dataclass
class RayRendering(Rendering):
    """Rendered latents of rays, with their opacity and depth.

    Attributes:
        opacity: ``[R]``, the sum of the weights along each ray.
        depth: ``[R]``, expected distance along the ray; light that nothing stops counts as stopped at ``far``.
    """

    opacity: Tensor = field(kw_only=True)
    depth: Tensor = field(kw_only=True)


class RadianceBackbone(PosedBackbone):
    """Draws rays of a :class:`Scene` and puts the scene's background behind them.

    Where a subclass draws from fewer rays than those of unmasked pixels, their flat indices are ``pool``, which holds
    none of the masked. A subclass gives ``render``, and of what :class:`Backbone` asks for ``total_steps`` and
    ``field_optimizers``.

    Args:
        scene: training and test views.
        batch_rays: rays a step, over all processes.
        transform, photometric, seed: see :class:`Backbone`.
    """

    eval_chunk = 8192
    rays_per_pixel = 1
    """Rays a pixel of a picture, see :func:`~ctm_plugin.rays.cameras.within_pixel`; several come from
    :class:`FixedDraws`."""

    def __init__(
        self, scene: Scene, batch_rays: int, transform: ColorTransform | None = None,
        photometric: Photometric | None = None, seed: int = 0,
    ):  # fmt: skip
        super().__init__(scene, batch_rays, transform, photometric, seed)
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
        rows = self.batch_rays // draws.world
        pixel = self._pixels(draws, rows, self.unmasked if self.pool is None else self.pool)
        rays = self.training_rays(pixel)
        behind, latent_behind = self.backgrounds(draws, rows)
        rgb = composite(self.pixels[pixel], self.photographed_behind(behind, pixel))
        return RayBatch(rgb, rays=rays, pixel=pixel, background=latent_behind)

    @torch.no_grad()
    def draw_those(self, hits: Callable[[Rays], Tensor]) -> None:
        """Draw training pixels from now on only where ``hits``, ``[R]``, is true of their rays; from all pixels where
        no ray hits.
        """
        pixels = self.unmasked
        if pixels is None:
            pixels = torch.arange(len(self.pixels), device=self.device, dtype=torch.int32)
        pool = torch.cat([part[hits(self.training_rays(part.long()))] for part in pixels.split(POOL_CHUNK)])
        self.pool = pool if len(pool) else None

    def predict(self, batch: RayBatch, draws: Draws) -> RayRendering:
        return self.render(batch.rays, batch.background, draws)

    @torch.no_grad()
    def render_rays(self, rays: Rays, color: Tensor | None = None, even: FixedDraws | None = None) -> RayRendering:
        """Render any number of rays in chunks, without randomness, over a colour ``[1, 3]``, by default the constant
        background; ``even``: the numbers that take the place of random ones.
        """
        background = self.transform.encode(self.constant_background() if color is None else color)
        size = self.eval_chunk * times_a_chunk(self.device)
        starts = range(0, len(rays.origins), size)
        chunks = [self.render(rays[start : start + size], background, even) for start in starts]
        latent = torch.cat([chunk.latent.float() for chunk in chunks])
        opacity = torch.cat([chunk.opacity for chunk in chunks])
        depth = torch.cat([chunk.depth for chunk in chunks])
        return RayRendering((latent,), opacity=opacity, depth=depth)

    def render_view(self, views: Views, index: int, every: int = 1, rays: int | None = None) -> dict[str, Tensor]:
        """Render one view: ``rgb`` ``[H, W, 3]``, ``latent`` ``[H, W, k]``, ``depth`` and ``opacity`` ``[H, W]``.

        Each is the mean over the rays of a pixel, but ``rgb``, which is decoded from the mean latent.

        Args:
            views, index: the view.
            every: render each ``every``-th row and column, the first ones included.
            rays: rays a pixel, a square number, 1 through its centre; ``None``: as many as the backbone's pictures.
        """
        count = self.rays_per_pixel if rays is None else rays
        height, width = views.height, views.width
        pixel = torch.arange(height * width, device=self.device).view(height, width)[::every, ::every]
        c2w, intrinsics, distortion = (
            None if of_all is None else of_all[index : index + 1].to(self.device)
            for of_all in (views.c2w, views.intrinsics, views.distortion)
        )
        pixels: dict[str, Tensor] = {}
        for right, down, offset in within_pixel(count):
            through = pixel_rays(c2w, intrinsics, height, width, pixel.flatten(), distortion, right, down)
            out = self.render_rays(through, even=FixedDraws(offset, self.device) if count > 1 else None)
            for name in ("latent", "depth", "opacity"):
                pixels[name] = pixels.get(name, 0) + getattr(out, name) / count
        shaped = {"rgb": self.decode(pixels["latent"])} | pixels
        return {name: value.unflatten(0, pixel.shape) for name, value in shaped.items()}
