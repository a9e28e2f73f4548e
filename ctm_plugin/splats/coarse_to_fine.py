"""Coarse to fine training: pictures are averaged over squares of pixels at first."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ctm_plugin.scene.shrink import shrink, shrink_mask
from ctm_plugin.scene.views import Views, unit

SIDES = (4, 2)
"""Pixels along the averaging squares of the stages before full size."""
MIN_SIDE = 80
"""Least shorter side in pixels of an averaged picture."""
MAX_VIEWS = 16
"""Most views whose detail is measured."""
OCTAVES = 5
"""Octaves whose detail is measured: coarser ones are in all pictures."""
STAGE_POWER = 0.6
"""Exponent of a stage's share of detail in its share of steps: steps of few pixels cost little (tried on bike and
chair)."""


class Stage(NamedTuple):
    """A stage of the training's schedule, with its downscaling.

    Attributes:
        side: side in pixels of the squares that are averaged into one pixel.
        until: end of the stage, as a share of the schedule.
    """

    side: int
    until: float


def stages(views: Views) -> list[Stage]:
    """Find the stages of smaller pictures: each lasts until ``share ** 0.6`` of the schedule.

    It is their share of all detail, the sum of a picture's amplitudes over its frequencies. An octave, from
    squares of s to those of 2 s pixels, has ``rms / s`` of it. So smooth scenes stay coarse for long, leaves do not.
    Weighing frequencies so is DashGaussian's idea (Chen et al., CVPR 2025).
    """
    sides = [side for side in SIDES if min(views.height, views.width) // side >= MIN_SIDE and _counts(views, side)]
    powers = torch.zeros(OCTAVES, dtype=torch.float64)
    for index in range(0, len(views) if sides else 0, -(-len(views) // MAX_VIEWS)):
        picture = unit(views.images[index]).cpu()[..., :3].permute(2, 0, 1)[None]
        for octave in range(OCTAVES):
            coarse = F.avg_pool2d(picture, 2)
            finer = picture[:, :, : 2 * coarse.shape[2], : 2 * coarse.shape[3]]
            powers[octave] += (finer - F.interpolate(coarse, scale_factor=2)).square().mean()
            picture = coarse
    details = powers.sqrt() / 2.0 ** torch.arange(OCTAVES)
    held = details.flip(0).cumsum(0).flip(0) / details.sum().clamp_min(1e-12)
    return [Stage(side, float(held[side.bit_length() - 1]) ** STAGE_POWER) for side in sides]


def _counts(views: Views, side: int) -> bool:
    """Whether each picture has a square of ``side`` pixels without masked ones."""
    mask = _masks(views, side)
    return mask is None or bool(mask.flatten(1).any(1).all())


def _masks(views: Views, side: int) -> Tensor | None:
    if views.mask is None:
        return None
    high, wide = views.height // side, views.width // side
    return torch.stack([shrink_mask(mask[: high * side, : wide * side], high, wide) for mask in views.mask])


def averaged(views: Views, side: int) -> Views:
    """Average pictures over squares of ``side`` pixels, with alpha of premultiplied colour.

    Squares that are partly masked do not count; those that reach over the right or the lower edge are left out.
    """
    high, wide = views.height // side, views.width // side
    images = [shrink(unit(image[: high * side, : wide * side]), high, wide) for image in views.images]
    return replace(
        views, images=torch.stack(images), intrinsics=views.intrinsics / side, mask=_masks(views, side), sizes=None
    )
