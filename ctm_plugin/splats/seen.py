"""Visibility of Gaussians: how many pixels each of them makes, in how many cameras, and its least width."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from ctm_plugin.splats.gaussians import EPS2D, Camera, Gaussians
from ctm_plugin.splats.render import picture
from ctm_plugin.splats.start import SH_C0


def pixels_made(gaussians: Gaussians, cameras: Sequence[Camera]) -> Float[Tensor, " n"]:
    """Contribution in pixels of each Gaussian to a mean picture: the sum of its ``alpha_i T_i``, see
    :func:`~ctm_plugin.splats.render.picture`; 0 where no camera sees it.

    Pictures are linear in colours: the sum is the gradient of a grey picture's sum in the Gaussian's colour.
    """
    grey = gaussians.sh0.new_zeros(len(gaussians.sh0), 1, requires_grad=True)
    bare = Gaussians(*(table.detach() for table in gaussians))._replace(sh0=grey, shN=grey.new_zeros(len(grey), 0))
    shift = torch.zeros_like(bare.means[:, :2])
    for camera in cameras:
        picture(bare, camera, shift, 1, 0.0, 0)[0].sum().backward()
    return grey.grad[:, 0] / (SH_C0 * len(cameras))


def times_seen(places: Float[Tensor, "n 3"], cameras: Sequence[Camera]) -> Int64[Tensor, " n"]:
    """Number of cameras that have each point in their frame, taken as pinholes, occlusion ignored."""
    times = torch.zeros(len(places), dtype=torch.long, device=places.device)
    for camera in cameras:
        x, y, z = ((places - camera.centre) @ camera.turn.T).unbind(1)
        across, down = camera.lens[0] * x / z + camera.lens[2], camera.lens[1] * y / z + camera.lens[3]
        times += (z > camera.near) & (across > 0) & (across < camera.width) & (down > 0) & (down < camera.height)
    return times


def as_wide_as_pixels(gaussians: Gaussians, cameras: Sequence[Camera]) -> Gaussians:
    """Widen Gaussians by 0.3 pixels squared of the nearest camera: ``s^2 + 0.3 (d / f)^2``, d depth, f focal length.

    Renderings with smaller pixels than the training pictures' then have no gaps.
    """
    centres = torch.stack([camera.centre for camera in cameras])
    pixels = torch.stack([1 / camera.lens[:2].mean() for camera in cameras])
    pixel = (torch.cdist(gaussians.means, centres) * pixels).amin(1, keepdim=True)
    return gaussians._replace(scales=((2 * gaussians.scales).exp() + EPS2D * pixel.square()).log() / 2)
