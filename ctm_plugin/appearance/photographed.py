"""Renderings of a field as each photograph shows them, under its appearance, for the loss."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.appearance.exposure import Exposure, PixelPlaces
from ctm_plugin.color.srgb import linear_to_srgb, srgb_to_linear
from ctm_plugin.color.transform import ColorTransform

CLIPPED_GRADIENT = 0.01
"""Share of the gradient that passes where light is clipped: without it, what is too bright once would stay so."""


def exposed(appearance: Exposure, rgb: Float[Tensor, "r 3"], place: PixelPlaces) -> Float[Tensor, "r 3"]:
    """Colours of the field as the pictures show them: sRGB >= 0 to sRGB in [0, 1], through linear light."""
    light = appearance(srgb_to_linear(rgb), place)
    return linear_to_srgb(light.clamp(0, 1) + CLIPPED_GRADIENT * (light - light.detach()))


def photographed(
    appearance: Exposure, transform: ColorTransform, latent: Float[Tensor, "r k"], place: PixelPlaces
) -> Float[Tensor, "r k"]:
    """Apply the appearance to a rendering F, in the transform's space: ``F + f(A(g(F))) - f(g(F))``.

    f encodes, g decodes, A is :func:`exposed`. Where g inverts f exactly it is ``f(A(g(F)))``; where it does not, as
    with a learned transform, a picture whose appearance is the identity has F itself all the same.
    """
    rgb = transform.decode(latent).clamp(min=0)
    changed, same = transform.encode(torch.cat([exposed(appearance, rgb, place), rgb])).chunk(2)
    return latent + (changed - same)


@torch.no_grad()
def undo_exposure(appearance: Exposure, rgb: Float[Tensor, "r 3"], place: PixelPlaces) -> Float[Tensor, "r 3"]:
    """Map photographs' colours to the field's exposure, sRGB in [0, 1], where parts of a field are compared with them.

    Without gradient: an appearance that learned from it would make all colours alike.
    """
    return linear_to_srgb(appearance.undone(srgb_to_linear(rgb), place).clamp(0, 1))
