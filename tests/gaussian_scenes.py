"""Gaussians and cameras that rasterisers are tried with, and the picture of them pixel by pixel, from the formula."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ctm_plugin.scene.views import Views
from ctm_plugin.splats.gaussians import MAX_ALPHA, MIN_ALPHA, Camera, Gaussians, ProjectedGaussians, camera_of, project
from ctm_plugin.splats.render import picture

LENS = (0.05, -0.2, 0.003, -0.002, 0.01)
DOUBLE = torch.float64
FLOOR = -0.1
NEAR = 0.2


def views_of(
    c2w: Tensor, lens: tuple[float, ...], width: int, height: int, distortion: tuple[float, ...] | None = None
) -> Views:
    """Black pictures of cameras ``[N, 3, 4]`` of one kind."""
    count = len(c2w)
    return Views(
        torch.zeros(count, height, width, 3, dtype=torch.uint8),
        c2w.float(),
        torch.tensor([lens]).repeat(count, 1),
        tuple(f"v{index}" for index in range(count)),
        distortion=None if distortion is None else torch.tensor([distortion]).repeat(count, 1),
    )


class Setting(NamedTuple):
    """What there is to render: N Gaussians, a camera, how many degrees of harmonics."""

    gaussians: Gaussians
    camera: Camera
    degrees: int

    def rendered(self, run: Callable, dtype: torch.dtype, more: int = 0) -> tuple[Gaussians, Tensor, Tensor, Tensor]:
        """Tables and shift as leaves of a type, the picture and the light that is left by a function of
        :func:`ctm_plugin.splats.render.picture`'s arguments."""
        tables = Gaussians(*(each.detach().to(dtype).clone().requires_grad_() for each in self.gaussians))
        shift = torch.zeros(len(tables.means), 2, dtype=dtype, requires_grad=True)
        return tables, shift, *run(tables, of_type(self.camera, dtype), shift, self.degrees, FLOOR, more)

    def projected(self) -> ProjectedGaussians:
        """In float64."""
        tables = Gaussians(*(each.double() for each in self.gaussians))
        shift = torch.zeros(len(tables.means), 2, dtype=torch.float64)
        return project(tables, of_type(self.camera, torch.float64), shift, self.degrees, FLOOR)


def of_type(camera: Camera, dtype: torch.dtype) -> Camera:
    return Camera(*(each.to(dtype) if isinstance(each, Tensor) else each for each in camera))


def setting(
    count: int = 40, channels: int = 3, degrees: int = 3, lens: bool = False, width: int = 37, height: int = 29,
    seed: int = 3, sizes: tuple[float, ...] = (-1.6, -1.6, -1.6), spread: float = 0.9, opacity: float = 0.5,
) -> Setting:  # fmt: skip
    """Random Gaussians round the origin before a slightly tilted camera four away.

    Args:
        count, channels, degrees: of the Gaussians.
        lens: whether it distorts.
        width, height: of the picture, whose scale they leave alone.
        seed: of all.
        sizes: logarithms of standard deviations along a Gaussian's axes, about.
        spread: standard deviation of the places.
        opacity: before the sigmoid, about.
    """
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    gaussians = Gaussians(
        means=spread * normal(count, 3),
        scales=0.4 * normal(count, 3) + torch.tensor(sizes),
        quats=normal(count, 4),
        opacities=1.5 * normal(count, 1) + opacity,
        sh0=0.8 * normal(count, channels) + 0.5,
        shN=0.2 * normal(count, (degrees**2 - 1) * channels),
    )
    turn, _ = torch.linalg.qr(torch.eye(3) + 0.1 * normal(3, 3))
    turn = turn * turn.diagonal().sign()
    c2w = torch.cat([turn, (turn @ torch.tensor([0.1, -0.1, 4.0]))[:, None]], 1)
    views = views_of(c2w[None], (28.0, 30.0, width * 0.47, height * 0.54), width, height, LENS if lens else None)
    return Setting(gaussians, camera_of(views, 0, NEAR), degrees)


def pixel_by_pixel(projected: ProjectedGaussians, camera: Camera) -> tuple[Tensor, Tensor]:
    """The picture ``[k, H, W]`` in float64, and the light that is left, ``[H, W]``."""
    names = ("means", "conics", "opacities", "colors", "depths", "extents")
    means, conics, opacities, colors, depths, extents = (
        getattr(projected, name).detach().double().numpy() for name in names
    )
    image, left = np.zeros((colors.shape[1], camera.height, camera.width)), np.ones((camera.height, camera.width))
    order = [each for each in np.argsort(depths, kind="stable") if extents[each].all()]
    for row in range(camera.height):
        for column in range(camera.width):
            for each in order:
                x, y = column + 0.5 - means[each, 0], row + 0.5 - means[each, 1]
                a, b, c = conics[each]
                alpha = min(opacities[each] * math.exp(-0.5 * (a * x * x + 2 * b * x * y + c * y * y)), MAX_ALPHA)
                if alpha >= MIN_ALPHA:
                    image[:, row, column] += left[row, column] * alpha * colors[each]
                    left[row, column] *= 1 - alpha
    return torch.from_numpy(image), torch.from_numpy(left)


def alphas(projected: ProjectedGaussians, camera: Camera) -> Tensor:
    """What each Gaussian stops at each pixel, before any bound: ``[N, H, W]``; of those that are shown, else 0."""
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    dx, dy = (at - mean[:, None, None] for at, mean in zip((x, y), projected.means.T, strict=True))
    a, b, c = (each[:, None, None] for each in projected.conics.T)
    shown = projected.opacities * (projected.extents > 0).all(1)
    return shown[:, None, None] * (-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy)).exp()


def certain(projected: ProjectedGaussians, camera: Camera, margin: float) -> Tensor:
    """Pixels where no Gaussian's alpha lies so close to a bound that rounding could take it over, ``[H, W]``."""
    found = alphas(projected, camera).detach()
    return ((found / MIN_ALPHA - 1).abs() > margin).all(0) & ((found / MAX_ALPHA - 1).abs() > margin).all(0)


SETTINGS = {
    "through a lens": setting(40, lens=True),
    "of five channels and all harmonics": setting(40, channels=5, degrees=4),
    "of one channel and no harmonics": setting(200, channels=1, degrees=1, lens=True),
    "of whole tiles": setting(60, degrees=2, width=48, height=16),
    "less than a tile": setting(60, width=5, height=3, lens=True),
    "behind the camera and beside the frame": setting(300, spread=4.0),
    "beside the frame of a lens": setting(300, spread=4.0, lens=True, seed=5),
    "nearly transparent": setting(300, opacity=-5.0),
    "needles": setting(120, sizes=(0.8, -5.0, -5.0), width=70, height=50),
    "discs": setting(80, sizes=(0.3, 0.3, -6.0), width=70, height=50, lens=True),
    "specks": setting(300, sizes=(-6.0, -6.0, -6.0), opacity=3.0),
}


def both_ways(of: Setting, counts: Tensor, more: int = 0) -> list[dict[str, Tensor]]:
    """Picture, light left and all gradients by a function and by plain torch; of a loss of the pixels that
    count."""
    found = []
    for run, dtype in ((picture, torch.float32), (picture.reference, DOUBLE)):
        tables, shift, image, left = of.rendered(run, dtype, more)
        waves = torch.linspace(0, 40, image.numel(), dtype=dtype).reshape(image.shape).sin() * counts
        loss = ((image - 0.3).square() * waves).sum() + (left * waves[0].roll(3) * counts).sum()
        gradients = torch.autograd.grad(loss, [*tables, shift])
        named = dict(zip((*tables._fields, "shift"), gradients, strict=True))
        found.append({"image": image.detach(), "left": left.detach()} | named)
    return found


def close(found: dict[str, Tensor], expected: dict[str, Tensor], counts: Tensor, within: float) -> None:
    """Pictures where they count, gradients by a table's largest."""
    for name, value in expected.items():
        seen = name in ("image", "left")
        assert found[name].shape == value.shape
        apart = (found[name].double() - value).abs() * (counts if seen else 1)
        bound = within * max([1.0 if seen else 1e-3, *value.abs().flatten().tolist()])
        assert (apart <= bound).all(), f"{name}: {float(apart.max() / bound)} times the bound"
