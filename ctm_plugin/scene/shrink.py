"""Pictures, masks and depth with fewer pixels."""

from __future__ import annotations

import math

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Float32
from scipy.sparse import csr_array
from torch import Tensor

from ctm_plugin.scene.views import Pixels, unit

FULL_COVERAGE = 1 - 1e-5
"""Share of a pixel's area that counts as all, but for rounding."""
STRIP = 16
"""Rows of a downscaled picture that are computed at once: all in float32 would fill the memory."""


def shrink(image: Pixels, height: int, width: int) -> Float32[Tensor, "h2 w2 c"]:
    """Downscale a picture by means over each larger pixel's area; with alpha, of premultiplied colour.

    Colour is ``mean(a c) / mean(a)``: ``[H, W, C]`` with straight alpha in and out; 0 where alpha is 0.
    """
    if image.shape[:2] == (height, width):
        return unit(image)
    if image.shape[-1] == 3:
        return area(image, height, width)
    image = unit(image)
    alpha = image[..., 3:]
    small = area(torch.cat([image[..., :3] * alpha, alpha], dim=-1), height, width)
    colour, alpha = small[..., :3], small[..., 3:]
    colour = torch.where(alpha > 0, colour / alpha.clamp(min=1e-12), 0.0).clamp(max=1.0)
    return torch.cat([colour, alpha], dim=-1)


def area(image: Pixels, height: int, width: int) -> Float32[Tensor, "h2 w2 c"]:
    """Means over the areas that ``height`` x ``width`` equal pixels cover, parts of pixels counted as parts.

    Pillow's box filter takes a pixel whole or not at all, which moves edges by up to half a pixel.
    """
    down, across = image.shape[0] / height, image.shape[1] / width
    if down == across and down.is_integer():
        strips = image.split(STRIP * int(down))
        return torch.cat([F.avg_pool2d(unit(each).permute(2, 0, 1), int(down)).permute(1, 2, 0) for each in strips])
    rows, columns = (parts(*sides) for sides in zip(image.shape[:2], (height, width), strict=True))
    small = torch.empty(height, width, image.shape[2])
    for begin in range(0, height, STRIP):
        some = rows[begin : begin + STRIP]
        low, high = some.indices.min(), some.indices.max() + 1
        strip = (some[:, low:high] @ unit(image[low:high]).flatten(1).numpy()).reshape(-1, *image.shape[1:])
        strip = columns @ strip.swapaxes(0, 1).reshape(image.shape[1], -1)
        small[begin : begin + STRIP] = torch.from_numpy(strip.reshape(width, -1, image.shape[2])).transpose(0, 1)
    return small.clamp(max=1.0)


def parts(count: int, few: int) -> csr_array:
    """Weights ``[few, count]`` of means over ``few`` equal parts of ``count`` pixels."""
    edges = np.arange(few + 1) * count / few
    low, high, pixel = edges[:-1, None], edges[1:, None], np.arange(math.ceil(count / few) + 1)
    pixel = np.floor(low).astype(int) + pixel
    part = (np.minimum(high, pixel + 1) - np.maximum(low, pixel)).clip(min=0) * few / count
    row = np.arange(few).repeat(pixel.shape[1])
    places = (row, pixel.clip(max=count - 1).ravel())
    return csr_array((part.ravel().astype(np.float32), places), (few, count))


def shrink_mask(mask: Bool[Tensor, "h w"], height: int, width: int) -> Bool[Tensor, "h2 w2"]:
    """Downscale a mask: a larger pixel counts where all pixels that it covers count."""
    return area(mask[..., None].float(), height, width)[..., 0] > FULL_COVERAGE


def shrink_depth(depth: Float[Tensor, "h w"], height: int, width: int) -> Float[Tensor, "h2 w2"]:
    """Downscale depth ``[H, W]`` to the value nearest each larger pixel's centre: means over edges lie on no surface.

    Where a centre lies between pixels, the one below right is taken.
    """
    row, column = (
        (2 * torch.arange(small) + 1) * large // (2 * small)
        for large, small in zip(depth.shape, (height, width), strict=True)
    )
    return depth[row][:, column]
