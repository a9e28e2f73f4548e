"""Backbones that render a posed scene, by rays or by whole pictures: how they are scored, shown and lit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.appearance.exposure import PixelPlaces
from ctm_plugin.appearance.photographed import exposed, photographed, undo_exposure
from ctm_plugin.backbones.base import Backbone, Compared
from ctm_plugin.color.light import AS_IS, Light, chosen_light, find_light, squares
from ctm_plugin.color.photometric import Photometric
from ctm_plugin.color.srgb import linear_to_srgb
from ctm_plugin.color.transform import ColorTransform, Uniform
from ctm_plugin.draws import Draws
from ctm_plugin.errors import CTMError
from ctm_plugin.metrics.detail import detail_moments
from ctm_plugin.metrics.evaluate import Scoring, summarize
from ctm_plugin.metrics.precision import full_float32
from ctm_plugin.rays.cameras import Rays, pixel_rays
from ctm_plugin.scene.frustum import camera_ball, frustum_box
from ctm_plugin.scene.kinds import GEOMETRIES
from ctm_plugin.scene.views import Scene, Views, composite, unit
from ctm_plugin.show.pictures import depth_picture, latent_picture, write_png
from ctm_plugin.show.snapshot import Snapshot, compared

UNIFORM_VARIANCE = 1 / 12
"""Variance of numbers uniform in [0, 1], about that of lit pictures; the weights of regularisers are made for it."""


class PosedBackbone(Backbone):
    """Renders a :class:`Scene` from any camera, in front of the scene's background.

    :class:`~ctm_plugin.backbones.radiance.RadianceBackbone` renders rays, a
    :class:`~ctm_plugin.backbones.pictures.PictureBackbone` whole pictures; they give ``draw``, ``predict`` and
    ``render_view``. Masked pixels are never trained on.

    Args:
        scene: training and test views.
        batch_rays: training pixels a step, over all processes.
        transform, photometric, seed: see :class:`Backbone`.
    """

    Scene = Scene
    posed = True
    geometries = GEOMETRIES
    """Geometries that it can train on; ``dataset.geometry=auto`` chooses among them."""
    relative = False
    """Whether photometric terms are divided by 12 times the variance of the training colours."""
    max_scale = 1.0
    """Largest factor by which films are wider than the training's pictures."""

    def __init__(
        self, scene: Scene, batch_rays: int, transform: ColorTransform | None = None,
        photometric: Photometric | None = None, seed: int = 0,
    ):  # fmt: skip
        super().__init__(transform, photometric, seed)
        self.scene = scene
        self.batch_rays = batch_rays
        self.loss_scale = 1.0
        self.register_buffer("c2w", scene.train.c2w, persistent=False)
        self.register_buffer("distortion", scene.train.distortion, persistent=False)
        self.learn_from(scene.train)

    def learn_from(self, views: Views) -> None:
        """Train on ``views`` from here on: the scene's training views, or these with fewer pixels."""
        self.views, mask = views, views.mask
        unmasked = None if mask is None else mask.flatten().nonzero().squeeze(1).int()
        for name, table in (
            ("pixels", views.images.flatten(0, 2)), ("intrinsics", views.intrinsics), ("unmasked", unmasked),
        ):  # fmt: skip
            self.register_buffer(name, None if table is None else table.to(self.device), persistent=False)

    @torch.no_grad()
    def on_train_start(self) -> None:
        super().on_train_start()
        if self.relative and self.batches_seen == 0:
            colors = self.some_colors()
            # A transform that is not trained yet may have next to none; half a grey level's is the least of any scene.
            spread = max(of.var(0).mean().item() for of in (colors, self.transform.encode(colors)))
            self.set_loss_scale(UNIFORM_VARIANCE / max(spread, 0.002**2))

    def set_loss_scale(self, scale: float) -> None:
        """Weigh all photometric terms by ``scale``, in place of the scale that they had.

        Raises:
            ValueError: it is no positive number.
        """
        if not 0 < scale < math.inf:
            raise ValueError(f"a loss of {scale} times its weight")
        self.photometric = replace(self.photometric, weight=self.photometric.weight * (scale / self.loss_scale))
        self.loss_scale = scale

    def query(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Density and colour at points, for programs that take a field elsewhere.

        Args:
            points: ``[M, 3]`` of the scene's world.
            directions: ``[M, 3]``, unit length, along which each is looked at.

        Returns:
            Density ``[M]``, optical depth a unit of length (in NDC of depth), 0 where nothing is; and latents
            ``[M, k]``, not defined where it is 0.

        Raises:
            CTMError: the backbone does not tell.
        """
        raise CTMError(f"{type(self).__name__} has no method query, which gives densities at points")

    def world_box(self) -> Float[Tensor, "2 3"]:
        """Box of what a mesh is made of: what training views see up to far; of unbounded scenes the cameras' ball."""
        scene = self.scene
        if scene.geometry != "unbounded":
            return frustum_box(scene.train, scene.near, scene.far)
        centre, radius = camera_ball(scene.train, scene.near)
        return torch.stack([centre - radius, centre + radius])

    def place(self, pixel: Tensor, rendered: Tensor) -> PixelPlaces:
        """Positions of training pixels ``[R]`` on their pictures, with the colours rendered there, ``[R, 3]`` sRGB."""
        height, width = self.views.height, self.views.width
        row = pixel.div(width, rounding_mode="floor")
        at = torch.stack([(pixel % width + 0.5) / width, (row % height + 0.5) / height], dim=-1)
        return PixelPlaces(row.div(height, rounding_mode="floor"), at, rendered.detach())

    def compare(self, batch: Any, latents: list[Tensor], uniform: Uniform) -> Compared:
        """Compare as every backbone does, with the appearance on renderings ``[R, k]`` and undone in the colours."""
        if (appearance := self.appearance) is None:
            return super().compare(batch, latents, uniform)
        place = self.place(batch.pixel, self.decode(latents[-1]))
        as_shown = [photographed(appearance, self.transform, latent, place) for latent in latents]
        terms, _ = self.transform.losses(as_shown, batch.rgb, self.photometric, uniform)
        rgb = undo_exposure(appearance, batch.rgb, place)
        return Compared(terms | appearance.regularisers(), self.transform.encode(rgb).detach(), rgb)

    def scene_colors(self, draws: Draws, count: int) -> Tensor:
        pixel = self._pixels(draws, count, self.unmasked)
        return composite(self.pixels[pixel], self.constant_background())

    def _pixels(self, draws: Draws, count: int, pool: Tensor | None) -> Tensor:
        """Draw flat indices ``[count]`` of training pixels out of ``pool``; ``None``: out of all."""
        drawn = draws.integers(len(self.pixels) if pool is None else len(pool), count)
        return drawn if pool is None else pool[drawn].long()

    def training_rays(self, pixel: Tensor) -> Rays:
        """Rays of training pixels ``[R]``, by flat index over all views."""
        views = self.views
        return pixel_rays(self.c2w, self.intrinsics, views.height, views.width, pixel, self.distortion)

    def photographed_behind(self, behind: Tensor, pixel: Tensor) -> Tensor:
        """The colour behind training pixels ``[R]`` as their pictures would have shown it, ``[R or 1, 3]``."""
        if self.appearance is None or not self.scene.train.has_alpha:
            return behind
        # No camera took it: it counts as what each picture would have shown of it.
        behind = behind.expand(len(pixel), -1)
        with torch.no_grad(), torch.autocast(self.device.type, enabled=False):  # colours want more than half precision
            return exposed(self.appearance, behind, self.place(pixel, behind))

    @torch.no_grad()
    def backgrounds(self, draws: Draws, rows: int, first: int = 0) -> tuple[Tensor, Tensor]:
        """Draw colours to lie under training pixels, ``[rows, 3]``, and latents under their renderings, ``[rows, k]``;
        one of each where the background is constant.

        ``first`` is the number of the first row: every fourth row has the constant background where others are random.
        """
        with torch.autocast(self.device.type, enabled=False):  # colours want more than half precision
            kind, level = self.scene.background, self.scene.random_level
            if kind not in ("random", "random_matched"):
                color = self.constant_background()
                return color, self.transform.encode(color)
            # Uniform in what the scene has of the latent space, or colours as bright as the scene asks for.
            ends = self.transform.behind if kind == "random" else self.transform.filled
            low, high = ends if level is None else (0.0, level)
            drawn = low + (high - low) * draws.uniform(rows, self.channels if level is None else 3)
            if kind == "random":
                return torch.zeros(1, 3, device=self.device), drawn if level is None else self.transform.encode(drawn)
            random = self.transform.decode(drawn) if level is None else drawn
            # A quarter sees the background of evaluation, which the others would never meet.
            number = torch.arange(first, first + rows, device=self.device)[:, None]
            color = torch.where(number % 4 > 0, random, self.constant_background())
            return color, self.transform.encode(color)

    def constant_background(self) -> Tensor:
        """The colour ``[1, 3]`` behind the scene in evaluation: white for ``white``, else black."""
        return torch.full((1, 3), float(self.scene.background == "white"), device=self.device)

    def render_view(self, views: Views, index: int, every: int = 1, rays: int | None = None) -> dict[str, Tensor]:
        """Render one view: ``rgb`` ``[H, W, 3]``, ``latent`` ``[H, W, k]``, ``depth`` and ``opacity`` ``[H, W]``.

        Args:
            views, index: the view.
            every: render each ``every``-th row and column, the first ones included.
            rays: rays a pixel, where a backbone has several; ``None``: as many as its pictures have.
        """
        raise NotImplementedError

    # Evaluation.

    @property
    def light(self) -> Light:
        """Light in which pictures of the scene are displayed, found from the training pictures. Differences between
        their exposures are removed first, as far as they are known.
        """
        if self.scene.light is not None:
            return Light(*self.scene.light)
        if self.appearance is None:
            return self._light
        rgb, view, at = (each.to(self.device) for each in self._squares)
        return find_light(undo_exposure(self.appearance, rgb, PixelPlaces(view, at, rgb)))

    @cached_property
    def _light(self) -> Light:
        return find_light(self.scene.train.images, self.scene.train.mask)

    @cached_property
    def _squares(self) -> tuple[Tensor, Tensor, Tensor]:
        light, _, view, at = squares(self.scene.train.images, self.scene.train.mask)
        return linear_to_srgb(light), view, at

    @property
    def snapshots(self) -> Sequence[int]:
        """Indices of the test views that have a photograph; else of the first one."""
        views = self.scene.test
        return range(len(views)) if views.pictured is None else views.pictured.nonzero().flatten().tolist() or [0]

    def target(self, view: int) -> Float[Tensor, "h w 3"] | None:
        """A test view over the constant background, on the CPU; ``None``: there is no picture of it."""
        views = self.scene.test
        there = views.pictured is None or bool(views.pictured[view])
        return composite(views.images[view], self.constant_background().cpu()) if there else None

    def scores(self, folder: Path | None, scoring: Scoring) -> dict[str, Any]:
        """Render every test view and score the decoded colours against the pictures as captured.

        Where there is a ``folder``, writes ``lit/NAME.png`` and next to it ``photo``, the photograph, both lit where
        the scene is dark; ``dark`` (as rendered, of dark scenes), ``depth`` and ``latent``. Where there are pictures in
        normal light, lit views are scored against them.

        Returns:
            See :func:`ctm_plugin.metrics.evaluate.summarize`, with ``protocol``, ``light_factor``,
            ``light_contrast`` and ``light_saturation``.
        """
        scene, views = self.scene, self.scene.test
        light = chosen_light(scoring.light, self.light)
        targets = [self.target(view) for view in range(len(views))]
        self.eval()
        masks = None if views.mask is None else list(views.mask.cpu())
        rendered, depths, details = [], [], []
        with full_float32(self.device):
            for index in scoring.track(range(len(views)), "test views"):
                view = {name: value.float().cpu() for name, value in self.render_view(views, index).items()}
                rendered.append(view["rgb"])
                depths.append(view["depth"])
                pictures = {"lit": light.apply(view["rgb"])}
                if targets[index] is not None:
                    pictures["photo"] = light.apply(targets[index])
                photo = pictures.get("photo")
                mask = masks and masks[index]
                details.append(None if photo is None else detail_moments(pictures["lit"], photo, mask))
                if light != AS_IS:
                    pictures["dark"] = view["rgb"]
                pictures["depth"] = depth_picture(view["depth"], scene.near, scene.far)
                pictures["latent"] = latent_picture(view["latent"])
                for kind, picture in pictures.items() if folder else ():
                    write_png(folder / kind / f"{views.names[index]}.png", views.own(index, picture))
            result = summarize(
                views.names,
                rendered,
                targets,
                scene.exposure,
                depths,
                None if views.depth is None else list(views.depth),
                lpips=scoring.lpips,
                masks=masks,
                references=None if views.lit is None else list(unit(views.lit)),
                light=light,
                details=details,
            )
        lit = {"light_factor": light.gain, "light_contrast": light.contrast, "light_saturation": light.saturation}
        return result | lit | {"protocol": self._protocol(scoring.dataset)}

    def _protocol(self, dataset: Mapping[str, Any]) -> str:
        """Description of the evaluation that two runs must share for their scores to stand in one cell of a table."""
        views, known = self.scene.test, self.scene.exposure
        exposure = dataset.get("exposure", 1.0 if known is None else known)
        scored = len(views) if views.pictured is None else int(views.pictured.sum())
        return (
            f"{self.scene.name}, {scored} test views {views.width}x{views.height}, exposure {exposure}, "
            f"{'white' if self.scene.background == 'white' else 'black'} background, float RGB clipped to [0, 1], "
            f"PSNR and SSIM per image then mean"
        )

    def snapshot(self, view: int) -> Snapshot:
        """Show a test view next to its picture, if it has one (:func:`ctm_plugin.show.snapshot.compared`), and
        ``test/depth``. With one ray a pixel, as training waits for it.
        """
        scene, views, every = self.scene, self.scene.test, self.stride(self.scene.test.height, self.scene.test.width)
        seen = self.render_view(views, view, every, rays=1)
        seen = {name: value.float().cpu() for name, value in seen.items()}
        target = self.target(view)
        target = None if target is None else target[::every, ::every]
        mask = None if views.mask is None else views.mask[view, ::every, ::every].cpu()
        compared_views = compared(seen["rgb"], target, seen["latent"], scene.exposure, self.light, mask)
        compared_views.pictures["test/depth"] = depth_picture(seen["depth"], scene.near, scene.far)
        return compared_views
