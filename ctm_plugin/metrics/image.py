"""Pixel metrics: PSNR, SSIM, and the constant image a run has to beat.

Images are sRGB floats in [0, 1], channels last, ``[H, W, 3]`` or ``[N, H, W, 3]``; every metric is per image.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Float32, Float64
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure

from ctm_plugin.metrics.precision import full_float32

SSIM_WINDOW = 11
"""Pixels along SSIM's Gaussian window, and its standard deviation (Wang et al. 2004)."""
SSIM_SIGMA = 1.5
CONVERGENCE_MARGIN_DB = 1.0
"""PSNR in dB above a constant picture's that a converged run has at least."""


def psnr(
    prediction: Float[Tensor, "*batch h w c"],
    target: Float[Tensor, "*batch h w c"],
    mask: Bool[Tensor, "*batch h w"] | None = None,
) -> Float64[Tensor, "*batch"]:
    """Peak signal-to-noise ratio of each image, ``-10 log10(mean((p - t)^2))`` with peak 1.

    The mean over a test set is taken over these values, as papers do; pooling the squared errors first gives another
    number.

    Args:
        prediction, target: ``[..., H, W, C]`` in [0, 1]; C is 3 but for latent images.
        mask: which pixels count; ``None``: all do.

    Returns:
        ``[...]`` decibels; ``inf`` for equal images, NaN where the prediction holds a NaN, or no pixel counts.
    """
    squares = (prediction.double() - target.double()).square()
    if mask is None:
        return -10.0 * squares.mean(dim=(-3, -2, -1)).log10()
    counted = squares.where(mask[..., None], 0.0).sum(dim=(-3, -2, -1))
    return -10.0 * (counted / (mask.sum(dim=(-2, -1)) * squares.shape[-1])).log10()


def ssim_fits(height: int, width: int) -> bool:
    """Whether each side of an image, in pixels, holds SSIM's window of 11."""
    return min(height, width) >= SSIM_WINDOW


def ssim(
    prediction: Float[Tensor, "*batch h w 3"],
    target: Float[Tensor, "*batch h w 3"],
    mask: Bool[Tensor, "*batch h w"] | None = None,
) -> Float32[Tensor, "*batch"]:
    """Structural similarity of each image: Gaussian window 11, sigma 1.5, data range 1, mean over the channels.

    Only windows that lie inside the image count, as in Wang et al. 2004 ("Image Quality Assessment", IEEE TIP 13(4))
    and in scikit-image; torchmetrics' own mean includes the padded border.

    Args:
        prediction, target: ``[..., H, W, 3]`` in [0, 1], H and W at least 11.
        mask: which pixels count: windows that hold another one are left out; ``None``: all do.

    Returns:
        ``[...]`` in [-1, 1], 1 for equal images; NaN where the mask has room for no window.
    """
    height, width = target.shape[-3:-1]
    with full_float32(target.device):
        _, similarity = structural_similarity_index_measure(
            *(image.float().reshape(-1, *image.shape[-3:]).permute(0, 3, 1, 2) for image in (prediction, target)),
            sigma=SSIM_SIGMA,
            kernel_size=SSIM_WINDOW,
            data_range=1.0,
            return_full_image=True,
        )
    border = SSIM_WINDOW // 2
    inside = similarity[..., border:-border, border:-border]
    if mask is None:
        return inside.mean(dim=(-3, -2, -1)).reshape(target.shape[:-3])
    left_out = (~mask).float().reshape(-1, 1, height, width)
    whole = F.max_pool2d(left_out, SSIM_WINDOW, stride=1) == 0
    total = inside.mean(dim=1, keepdim=True).where(whole, 0.0).sum(dim=(-3, -2, -1))
    return (total / whole.sum(dim=(-3, -2, -1))).reshape(target.shape[:-3])


def best_constant_psnr(
    targets: Float[Tensor, "n h w 3"] | Sequence[Float[Tensor, "h w 3"]],
    masks: Sequence[Bool[Tensor, "h w"] | None] | None = None,
) -> float:
    """PSNR of the constant picture with the least squared error: one colour, the mean of all pixels, for all views.

    Args:
        targets: the test images, ``[N, H, W, 3]`` in [0, 1] or a sequence of ``[H, W, 3]``.
        masks: which pixels of each count; ``None``: all do.

    Returns:
        Decibels, the mean over images; ``inf`` when the targets are that one colour.
    """
    masks = [None] * len(targets) if masks is None else masks
    counted = [pixels_that_count(target, mask) for target, mask in zip(targets, masks, strict=True)]
    colour = torch.stack([pixels.double().sum(dim=0) for pixels in counted]).sum(dim=0) / sum(map(len, counted))
    each = [psnr(colour.expand(target.shape), target, mask) for target, mask in zip(targets, masks, strict=True)]
    return float(torch.stack(each).mean())


def pixels_that_count(image: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"] | None) -> Float[Tensor, "p 3"]:
    """The pixels ``[P, 3]`` of an image that count: all, or those where the mask is true."""
    return image.flatten(0, 1) if mask is None else image[mask]


def converged(value: float, constant: float) -> bool:
    """Whether a run beats the best constant picture by 1 dB; tables print "N.C." where it does not.

    Args:
        value: the run's PSNR in dB. NaN is not converged, ``inf`` (exact) is.
        constant: :func:`best_constant_psnr` in dB. Where it is ``inf`` nothing can beat it.
    """
    return value - constant >= CONVERGENCE_MARGIN_DB
