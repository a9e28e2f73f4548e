"""Picture of what a colour transform does to the colours."""

from __future__ import annotations

import itertools
import math

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageDraw
from torch import Tensor

from ctm_plugin.color.light import AS_IS, Light
from ctm_plugin.color.transform import ColorTransform
from ctm_plugin.show.pictures import below, beside, latent_picture

PICTURE_SIDE = 128
"""Side of the picture in pixels, points along an edge of the cube, and radius of a dot in pixels."""
LATTICE_POINTS = 9
DOT_RADIUS = 2
AROUND, ABOVE = math.radians(25), math.radians(25)
RIGHT = torch.tensor([-math.sin(AROUND), math.cos(AROUND), 0.0])
NEAR = torch.tensor([math.cos(ABOVE) * math.cos(AROUND), math.cos(ABOVE) * math.sin(AROUND), math.sin(ABOVE)])
UP = torch.linalg.cross(NEAR, RIGHT)
"""The viewer's axes: ``NEAR`` points to the viewer, ``RIGHT`` to the right, ``UP`` upwards."""


@torch.no_grad()
def cube_picture(
    transform: ColorTransform, colors: Float[Tensor, "n 3"], light: Light = AS_IS
) -> Float[Tensor, "h w 3"]:
    """Draw four cubes. Above: a lattice of RGB colours at their RGB and at their latents, each point in its own colour.
    Below: the same for some of the scene's colours, whose dots are lit, as dark ones would not be seen.

    Where k is not 3, latents lie at the colours that :func:`ctm_plugin.show.pictures.latent_picture` gives them.

    Args:
        transform: may be on any device.
        colors: sRGB in [0, 1], on the transform's device.
        light: light in which the scene's colours are displayed.
    """
    steps = torch.linspace(0, 1, LATTICE_POINTS, device=colors.device)
    lattice = torch.cartesian_prod(steps, steps, steps)
    lit = light.apply(colors).cpu()
    rows = [
        beside(dots(rgb.cpu(), shown), dots(latent_picture(transform.encode(rgb).float()), shown))
        for rgb, shown in ((lattice, lattice.cpu()), (colors, lit))
    ]
    return below(*rows)


def dots(places: Float[Tensor, "n 3"], colors: Float[Tensor, "n 3"]) -> Float[Tensor, "h w 3"]:
    """Draw coloured dots in the unit cube, seen from outside, the nearer ones in front."""
    canvas = Image.new("RGB", (PICTURE_SIDE, PICTURE_SIDE), (96, 96, 96))
    pen = ImageDraw.Draw(canvas)
    corners = torch.tensor(list(itertools.product((0.0, 1.0), repeat=3)))
    for a, b in itertools.combinations(range(8), 2):
        if (corners[a] - corners[b]).abs().sum() == 1:
            pen.line([tuple(point) for point in _seen(corners[[a, b]]).tolist()], fill=(150, 150, 150))
    order = ((places - 0.5) @ NEAR).argsort()
    levels = (colors[order].clamp(0, 1) * 255).round().byte().tolist()
    for (x, y), color in zip(_seen(places[order]).tolist(), levels, strict=True):
        pen.ellipse((x - DOT_RADIUS, y - DOT_RADIUS, x + DOT_RADIUS, y + DOT_RADIUS), fill=tuple(color))
    return torch.from_numpy(np.array(canvas)).float() / 255


def _seen(points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 2"]:
    """Project points of the unit cube to pixel positions in the picture."""
    centred = points - 0.5
    return PICTURE_SIDE * (0.5 + 0.6 * torch.stack([centred @ RIGHT, -(centred @ UP)], dim=1))
