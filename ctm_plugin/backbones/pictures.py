"""Backbones that render whole pictures, as rasterisers do: a step is a view, or a few."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.backbones.base import Batch, Rendering
from ctm_plugin.backbones.posed import PosedBackbone
from ctm_plugin.color.photometric import Photometric
from ctm_plugin.color.transform import ColorTransform
from ctm_plugin.draws import Draws
from ctm_plugin.errors import ConfigError
from ctm_plugin.scene.views import Scene, Views, composite


class RenderedView(NamedTuple):
    """A rendered picture of H x W pixels."""

    latent: Float[Tensor, "h w k"]
    opacity: Float[Tensor, "h w"]
    """The share of each pixel's light that the scene stops."""
    depth: Float[Tensor, "h w"] | None
    """Expected distance along the ray; light that nothing stops counts as stopped at ``far``. Pictures of a training
    step need none."""


@dataclass
class PictureBatch(Batch):
    """A training batch: the unmasked pixels of some training views, one view after the other, each row by row.

    Attributes:
        views: indices of the training views.
        pixel: ``[R]``, flat indices over all training views.
        backgrounds: the latent ``[1, k]`` behind each view.
        counted: for each view the indices of its unmasked pixels, ``[R_v]``, row by row; ``None``: all.
    """

    views: tuple[int, ...] = field(kw_only=True)
    pixel: Tensor = field(kw_only=True)
    backgrounds: list[Tensor] = field(kw_only=True)
    counted: list[Tensor] | None = field(kw_only=True)


@dataclass
class PictureRendering(Rendering):
    """Rendered whole pictures, and the latents of their unmasked pixels."""

    pictures: list[RenderedView] = field(kw_only=True)


class PictureBackbone(PosedBackbone):
    """Renders whole pictures; a training step is ``views_a_step`` views, over all processes.

    Views come in an order that is drawn anew for each pass over all of them. A subclass gives ``render``, and of what
    :class:`~ctm_plugin.backbones.base.Backbone` asks for ``total_steps`` and ``field_optimizers``.

    Args:
        scene: training and test views.
        views_a_step: at least as many as there are processes.
        transform, photometric, seed: see :class:`~ctm_plugin.backbones.base.Backbone`.
    """

    def __init__(
        self, scene: Scene, views_a_step: int = 1, transform: ColorTransform | None = None,
        photometric: Photometric | None = None, seed: int = 0,
    ):  # fmt: skip
        pixels = scene.train.height * scene.train.width
        super().__init__(scene, views_a_step * pixels, transform, photometric, seed)
        self.views_a_step = views_a_step

    def learn_from(self, views: Views) -> None:
        super().learn_from(views)
        self.ends = None if views.mask is None else [0, *views.mask.flatten(1).sum(1).cumsum(0).tolist()]

    def render(self, views: Views, index: int, background: Tensor, draws: Draws | None, every: int = 1) -> RenderedView:
        """Render a view in the latent space.

        Args:
            views, index: the view whose camera is rendered from; its photograph is not used.
            background: ``[1, k]`` latent, seen where light passes the scene.
            draws: random numbers in training; ``None`` in evaluation, which must be deterministic and have depth.
            every: render each ``every``-th row and column, the first ones included.
        """
        raise NotImplementedError

    def on_fit_start(self) -> None:
        super().on_fit_start()
        if self.views_a_step % self.trainer.world_size:
            expected = f"a multiple of trainer.devices, {self.trainer.world_size}: each process has its own views"
            raise ConfigError("backbone.views", self.views_a_step, expected)

    def draw(self, draws: Draws) -> PictureBatch:
        count = self.views_a_step // draws.world
        first = max(self.batches_seen - 1, 0) * self.views_a_step + draws.rank * count
        views = tuple(self.view_of(first + each) for each in range(count))
        height, width = self.views.height, self.views.width
        behind, latent = (each.expand(count, -1) for each in self.backgrounds(draws, count, first))
        counted = [self.counted(view) for view in views]
        pixels = [each + view * height * width for view, each in zip(views, counted, strict=True)]
        seen = [self.photographed_at(view, pixel) for view, pixel in zip(views, pixels, strict=True)]
        colors = [
            composite(shown, self.photographed_behind(color, pixel))
            for shown, pixel, color in zip(seen, pixels, behind.split(1), strict=True)
        ]
        return PictureBatch(
            torch.cat(colors), views=views, pixel=torch.cat(pixels), backgrounds=list(latent.split(1)),
            counted=None if self.ends is None else counted,
        )  # fmt: skip

    def counted(self, view: int) -> Tensor:
        """Indices of a training view's unmasked pixels, ``[R_v]``, row by row."""
        each = self.views.height * self.views.width
        if self.ends is None:
            return torch.arange(each, device=self.device)
        return self.unmasked[self.ends[view] : self.ends[view + 1]].long() - view * each

    def photographed_at(self, view: int, pixel: Tensor) -> Tensor:
        """The photographed colours at the unmasked pixels ``[R_v]`` of a training view."""
        each = self.views.height * self.views.width
        # Rows that lie one after the other need no look-up, which takes ten times as long.
        return self.pixels[view * each : (view + 1) * each] if self.ends is None else self.pixels[pixel]

    def view_of(self, number: int) -> int:
        """Index of the training view at place ``number``, from 0, in the random order in which views are trained on."""
        passes, place = divmod(number, len(self.scene.train))
        order = torch.randperm(len(self.scene.train), generator=Draws(self.seed, passes, stream="views").generator)
        return int(order[place])

    def predict(self, batch: PictureBatch, draws: Draws) -> PictureRendering:
        views = self.views
        pictures = [
            self.render(views, view, behind, draws) for view, behind in zip(batch.views, batch.backgrounds, strict=True)
        ]
        latents = [picture.latent.flatten(0, 1) for picture in pictures]
        if batch.counted is not None:
            latents = [latent.index_select(0, at) for latent, at in zip(latents, batch.counted, strict=True)]
        return PictureRendering((torch.cat(latents) if len(latents) > 1 else latents[0],), pictures=pictures)

    @torch.no_grad()
    def render_view(self, views: Views, index: int, every: int = 1, rays: int | None = None) -> dict[str, Tensor]:
        """See :meth:`~ctm_plugin.backbones.posed.PosedBackbone.render_view`; ``rays`` has no effect here."""
        background = self.transform.encode(self.constant_background())
        picture = self.render(views, index, background, None, every)
        latent = picture.latent.float()
        return {"rgb": self.decode(latent), "latent": latent, "depth": picture.depth, "opacity": picture.opacity}
