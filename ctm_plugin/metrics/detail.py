"""Detail: how much of what is real in a photograph's fine structure a rendering shows, though the photograph is noisy.

Noise of a photograph that was not trained on is independent of the rendering, so it does not change their covariance.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from ctm_plugin.metrics.image import SSIM_SIGMA, SSIM_WINDOW

SQUARE_SIDE, CELL_SIDE = 12, 4
"""Pixels along a square in which noise is measured, and along its cells, whose means tell whether it is flat."""
BRIGHTNESS_CLASSES, FLAT_SHARE = 3, 0.15
"""Number of classes of brightness, as noise depends on light, and the share of each class's squares that counts as
flat."""
MIN_BAND = 1e-6
"""Least absolute value of a picture's fine band; smaller ones are float32's rounding of flat areas."""
MIN_DETAIL = 0.05
"""Least share of the photograph's fine variance that must be detail for a score: noise is not known more exactly."""
MIN_SQUARES = 250
"""Least number of squares of a view with a score. With fewer, none is flat: of nine photographs without noise, up to
0.67 of the fine variance counted as noise at 128x96 pixels, 0.41 at 160x120, 0.24 at 200x150, but 0.11 of all but one
(fur: 0.25) at 250x188, which have 280."""


def detail_moments(
    rendered: Float[Tensor, "h w 3"], photograph: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"] | None = None
) -> Float64[Tensor, " 4"] | None:
    """The moments of a view's fine bands that :func:`detail` is made of.

    A picture's fine band is the mean of its channels less the same under SSIM's Gaussian window. Only pixels whose
    window lies inside the picture, and holds none that does not count, are taken.

    Args:
        rendered, photograph: one view in the same light, sRGB in [0, 1].
        mask: which pixels count; ``None``: all do.

    Returns:
        Sums over pixels of: rendered times photographed, rendered squared, photographed squared, and noise
        (:func:`noise_variance`); ``None`` where fewer than ``MIN_SQUARES`` count.
    """
    pair = torch.stack([each.float().mean(-1) for each in (rendered, photograph)])
    pair = pair if mask is None else pair.where(mask, 0.0)
    offsets = torch.arange(SSIM_WINDOW, device=pair.device) - SSIM_WINDOW // 2
    window = torch.softmax(-0.5 * (offsets / SSIM_SIGMA) ** 2, 0)
    edge = SSIM_WINDOW // 2
    inside = pair[:, edge:-edge, edge:-edge]
    if min(inside.shape[1:]) < SQUARE_SIDE:
        return None
    blurred = F.conv2d(F.conv2d(pair[:, None], window[None, None, None]), window[None, None, :, None])[:, 0]
    band, whole = inside - blurred, torch.ones_like(inside[0], dtype=torch.bool)
    band = band * (band.abs() > MIN_BAND)
    if mask is not None:
        whole = F.max_pool2d((~mask)[None].float(), SSIM_WINDOW, stride=1)[0] == 0
        band = band * whole
    noise = noise_variance(inside[1], band[1], whole)
    if noise is None:
        return None
    moments = ((band[0] * band[1]).sum(), band[0].square().sum(), band[1].square().sum(), noise * whole.sum())
    return torch.stack(moments).double()


def noise_variance(
    photograph: Float[Tensor, "h w"], band: Float[Tensor, "h w"], whole: Bool[Tensor, "h w"]
) -> Float[Tensor, ""] | None:
    """The variance of noise in a photograph's fine band, from where the photograph is flat.

    Squares are put into classes of equal size by their brightness. In each class those are flat whose cells' means
    differ least; the median of the band's variance in them is the class's noise. Found in the band itself, noise need
    not be white: pictures may be scaled or compressed.

    Args:
        photograph, band: grey values and what is fine in them.
        whole: which pixels count; squares must consist of such.

    Returns:
        The mean over classes; ``None`` where fewer than :data:`MIN_SQUARES` count.
    """
    cells = F.avg_pool2d(photograph[None], SQUARE_SIDE // CELL_SIDE)
    brightness = F.avg_pool2d(cells, CELL_SIDE)
    contrast = F.avg_pool2d(cells.square(), CELL_SIDE) - brightness.square()
    fine = F.avg_pool2d(band.square()[None], SQUARE_SIDE)
    counted = F.avg_pool2d(whole[None].float(), SQUARE_SIDE) == 1
    brightness, contrast, fine = brightness[counted], contrast[counted], fine[counted]
    if len(fine) < MIN_SQUARES:
        return None
    medians = [
        fine[of[contrast[of].argsort()[: max(1, round(FLAT_SHARE * len(of)))]]].median() * len(of)
        for of in brightness.argsort().tensor_split(min(BRIGHTNESS_CLASSES, len(fine)))
    ]
    return torch.stack(medians).sum() / len(fine)


def detail(moments: Sequence[Float64[Tensor, " 4"]]) -> float | None:
    """The share of the real fine detail of test photographs that rendered views show::

        detail = c^2 / (r (p - n)),  c >= 0

    With c the covariance of the fine bands of rendering and photograph, r and p their variances, n that of the
    photograph's noise. It estimates the squared correlation of the rendering with a photograph without noise. A factor
    on either picture does not change it; blur, displaced views and invented detail lower it.

    Args:
        moments: see :func:`detail_moments`, of all views; they are added.

    Returns:
        In [0, 1]; 0 for a rendering without any detail, ``None`` where ``p - n <= MIN_DETAIL p``.
    """
    if not moments:
        return None
    both, rendered, photographed, noise = torch.stack(list(moments)).sum(0).tolist()
    real = photographed - noise
    if real <= MIN_DETAIL * photographed:
        return None
    return min(max(both, 0.0) ** 2 / (rendered * real), 1.0) if rendered > 0 else 0.0
