"""BARF-2D: a neural image and the homographies of its patches, learned together (Lin et al., BARF, ICCV 2021)."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.optim import Adam, Optimizer

from ctm_plugin.backbones.base import Backbone, Batch, Rendering
from ctm_plugin.backbones.neural_image import NeuralImage, shown_frequencies
from ctm_plugin.backbones.settings import BARF2DConfig
from ctm_plugin.color.light import Light, chosen_light, enhancement_gain, find_light
from ctm_plugin.color.photometric import Photometric
from ctm_plugin.color.transform import ColorTransform
from ctm_plugin.draws import Draws, seeded
from ctm_plugin.errors import ConfigError
from ctm_plugin.metrics.evaluate import Scoring, summarize_alignment
from ctm_plugin.metrics.precision import full_float32
from ctm_plugin.metrics.rendered import Alignment
from ctm_plugin.rays.homography import pixel_grid, sl3_exp, warp
from ctm_plugin.scene.views import PlanarScene
from ctm_plugin.show.pictures import below, beside, latent_picture, outlines, write_png
from ctm_plugin.show.snapshot import Snapshot, compared

TRANSLATION = 2
"""Number of a homography's parameters that translate a patch; they come first."""
EVAL_CHUNK = 1 << 16
"""Pixels rendered at once outside training."""


@dataclass
class PixelBatch(Batch):
    """A training batch of BARF-2D: pixels of its five patches with their colours.

    Attributes:
        pixel: ``[5, R / 5]``, flat index within each patch; ``None``: all, in order.
    """

    pixel: Tensor | None = field(kw_only=True)


class BARF2D(Backbone):
    """BARF-2D, planar alignment: a network that gives the picture's latent at a position, and a homography a patch.

    The first patch stays where it is: the others are aligned with it.

    Args:
        config: sizes, steps, rates.
        scene: a picture's patches.
        transform, photometric, seed: see :class:`~ctm_plugin.backbones.base.Backbone`.
    """

    Config = BARF2DConfig
    Scene = PlanarScene

    def __init__(
        self,
        config: BARF2DConfig,
        scene: PlanarScene,
        transform: ColorTransform | None = None,
        photometric: Photometric | None = None,
        seed: int = 0,
    ):
        super().__init__(transform, photometric, seed)
        self.config, self.scene = config, scene
        self.total_steps = config.steps
        count, each = len(scene.patches), scene.patch**2
        self.batch_rays = count * each if config.pixels is None else config.pixels
        if self.batch_rays > count * each or self.batch_rays % count:
            expected = f"a multiple of {count}, at most {count * each}, all pixels of the patches"
            raise ConfigError("backbone.pixels", config.pixels, expected)
        self.register_buffer("pixels", scene.patches.flatten(1, 2), persistent=False)
        grid = pixel_grid(scene.height, scene.width, scene.patch).flatten(0, 1)
        self.register_buffer("grid", grid, persistent=False)
        frequencies = 0 if config.encoding == "none" else config.frequencies
        with seeded(seed):
            self.image = NeuralImage(self.channels, config.width, config.depth, frequencies, config.encoding == "barf")
        self.moved = nn.Parameter(torch.zeros(count - 1, 8))
        self.progress = 0.0

    @property
    def warps(self) -> Tensor:
        """Give the parameters ``[5, 8]`` of the patches' homographies; those of the first patch are 0."""
        moved = self.moved
        if self.progress < self.config.shifts_until:  # what has no gradient rests where it began
            moved = torch.cat([moved[:, :TRANSLATION], moved[:, TRANSLATION:].detach()], dim=1)
        return torch.cat([torch.zeros_like(moved[:1]), moved])

    # Training.

    def draw(self, draws: Draws) -> PixelBatch:
        count, each = self.pixels.shape[:2]
        rows = self.batch_rays // count // draws.world
        if self.config.pixels is not None:
            pixel = draws.integers(each, count * rows).view(count, rows)
        elif draws.world > 1:
            pixel = torch.arange(draws.rank * rows, (draws.rank + 1) * rows, device=self.device).expand(count, -1)
        else:
            return PixelBatch(self.pixels.flatten(0, 1), pixel=None)
        rgb = self.pixels.gather(1, pixel[..., None].expand(-1, -1, 3))
        return PixelBatch(rgb.flatten(0, 1), pixel=pixel)

    def scene_colors(self, draws: Draws, count: int) -> Tensor:
        colors = self.pixels.flatten(0, 1)
        return colors[draws.integers(len(colors), count)]

    def predict(self, batch: PixelBatch, draws: Draws) -> Rendering:
        points = self.grid if batch.pixel is None else self.grid[batch.pixel]
        return Rendering((self.latent_at(self.moved_points(points).flatten(0, 1)),))

    def moved_points(self, points: Tensor) -> Tensor:
        """Map points ``[N, 2]`` or ``[5, N, 2]`` of the patches into the picture by the homographies: ``[5, N, 2]``."""
        with torch.autocast(points.device.type, enabled=False):
            return warp(points, sl3_exp(self.warps))

    def latent_at(self, points: Tensor) -> Tensor:
        """Evaluate the neural image's latents ``[N, k]`` at positions ``[N, 2]``."""
        config, shown = self.config, None
        if config.encoding == "barf":
            shown = shown_frequencies(config.frequencies, self.progress, config.start, config.end, points.device)
        return self.image(points, shown)

    def field_optimizers(self) -> dict[str, Optimizer]:
        return {
            "image": Adam(self.image.parameters(), self.config.lr, fused=True),
            "warps": Adam([self.moved], self.config.lr_warp),
        }

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        self.progress = self.global_step / self.total_steps
        if self.config.warp_decay and self.between_steps:
            self.decay_warps()
        super().on_train_batch_start(batch, batch_idx)

    @torch.no_grad()
    def decay_warps(self) -> None:
        """Decay all homography parameters but translations, ``h (1 - lr decay)``, while frequencies come in."""
        if self.progress < self.config.end:
            self.moved[:, TRANSLATION:] *= 1 - self.config.lr_warp * self.config.warp_decay

    def stats(self) -> dict[str, float]:
        error = (self.warps.detach() - self.scene.true_warps.to(self.device)).norm(dim=-1).mean()
        return {"warp_error": error.item()}

    # Rendering.

    @torch.no_grad()
    def render_patches(self) -> Tensor:
        """Render latents ``[5, P, P, k]`` where the homographies put the patches."""
        side = self.scene.patch
        return self._rendered(self.moved_points(self.grid).flatten(0, 1)).view(-1, side, side, self.channels)

    @torch.no_grad()
    def render_image(self, every: int = 1) -> Tensor:
        """Render latents ``[H, W, k]`` of the whole picture, in the first patch's frame, which is the picture's own.

        Args:
            every: render each ``every``-th row and column, the first ones included.
        """
        grid = pixel_grid(self.scene.height, self.scene.width)[::every, ::every]
        return self._rendered(grid.flatten(0, 1).to(self.device)).unflatten(0, grid.shape[:2])

    def _rendered(self, points: Tensor) -> Tensor:
        return torch.cat([self.latent_at(part).float() for part in points.split(EVAL_CHUNK)])

    # Evaluation (paper, Table 3 and Figure 6).

    @cached_property
    def light(self) -> Light:
        """Light in which pictures of the scene are displayed, found from the patches as trained on."""
        return find_light(self.scene.patches)

    def scores(self, folder: Path | None, scoring: Scoring) -> dict[str, Any]:
        """Score the homographies and the patches; write :meth:`pictures` into ``folder``, unless that is ``None``.

        Returns:
            See :func:`ctm_plugin.metrics.evaluate.summarize_alignment`, with ``protocol``.
        """
        self.eval()
        scene = self.scene
        with full_float32(self.device):
            alignment = Alignment(
                rendered=self.decode(self.render_patches()).float().cpu(),
                clean=scene.clean,
                fused=self.decode(self.render_image()).float().cpu(),
                picture=scene.image,
                warps=self.warps.detach().cpu(),
                true_warps=scene.true_warps,
                gain=enhancement_gain(list(scene.clean), scene.exposure),
            )
            for name, picture in self.pictures(chosen_light(scoring.light, self.light)).items() if folder else ():
                write_png(folder / "lit" / f"{name}.png", picture)
            result = summarize_alignment(alignment)
        protocol = (
            f"{scene.name}, 5 patches of {scene.patch}x{scene.patch} out of {scene.width}x{scene.height}, "
            f"exposure {scene.exposure:g}, float RGB clipped to [0, 1]"
        )
        return result | {"protocol": protocol}

    @torch.no_grad()
    def pictures(self, light: Light) -> dict[str, Float[Tensor, "h w 3"]]:
        """Draw ``warps`` (outlines of the patches on the picture, the true ones thin and white), ``patches`` (as
        trained on, and below as rendered), ``fused`` and ``latent`` (the whole neural picture); lit but for
        the last."""
        latent = self.render_image().float().cpu()
        rendered = self.decode(self.render_patches()).float().cpu()
        return {
            "warps": self._outlined(light),
            "fused": light.apply(self.decode(latent.to(self.device)).cpu()),
            "patches": light.apply(below(beside(*self.scene.patches), beside(*rendered))),
            "latent": latent_picture(latent),
        }

    def snapshot(self, view: int) -> Snapshot:
        """Show the picture under alignment (:func:`ctm_plugin.show.snapshot.compared`), and ``test/warps``."""
        scene, light = self.scene, self.light
        every = self.stride(scene.height, scene.width)
        latent, target = self.render_image(every), scene.image[::every, ::every]
        shown = compared(self.decode(latent).cpu(), target, latent.float().cpu(), scene.exposure, light)
        shown.pictures["test/warps"] = self._outlined(light)[::2, ::2]
        return shown

    def _outlined(self, light: Light) -> Float[Tensor, "h w 3"]:
        """The whole picture, lit, under the outlines of the patches."""
        scene = self.scene
        return outlines(light.apply(scene.image), self.warps.detach().cpu(), scene.true_warps, scene.patch)

    # Checkpoints.

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        super().on_save_checkpoint(checkpoint)
        checkpoint["progress"] = self.progress

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        super().on_load_checkpoint(checkpoint)
        self.progress = checkpoint["progress"]
