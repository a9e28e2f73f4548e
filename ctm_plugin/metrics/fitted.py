"""Colour maps that are fitted before a picture is scored: to one half of a view, or to pictures in normal light."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from ctm_plugin.color.light import Light
from ctm_plugin.color.srgb import linear_to_srgb, srgb_to_linear
from ctm_plugin.metrics.image import pixels_that_count, psnr
from ctm_plugin.metrics.rendered import Lit


def psnr_fitted(
    prediction: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"] | None = None
) -> float | None:
    """PSNR of a view's right half after the colour matrix that fits its left half best, see :func:`fit_light`.

    No pixel that is scored has a part in the fit. It is the same map for all kinds of ``appearance``, none included, so
    that their scores can be compared.

    Args:
        prediction, target: sRGB in [0, 1].
        mask: which pixels count; ``None``: all do.

    Returns:
        Decibels; ``None`` where a half has no pixel that counts, or the prediction holds a NaN.
    """
    middle = target.shape[1] // 2
    halves = [
        (prediction[:, part], target[:, part], None if mask is None else mask[:, part])
        for part in (slice(middle), slice(middle, None))
    ]
    empty = any(not (part.numel() if mask is None else mask.any()) for part, _, mask in halves)
    if empty or not prediction.isfinite().all():
        return None
    matrix = fit_light(*(pixels_that_count(image, halves[0][2]) for image in halves[0][:2]))
    light = srgb_to_linear(halves[1][0].double()) @ matrix
    return float(psnr(linear_to_srgb(light.clamp(0, 1)), halves[1][1], halves[1][2]))


def fit_light(prediction: Float[Tensor, "p 3"], target: Float[Tensor, "p 3"]) -> Float64[Tensor, "3 3"]:
    """The matrix of linear light with the least squared error of sRGB, to first order about the target.

    ``argmin_M sum_pc [s'(y_pc) ((x M)_pc - y_pc)]^2``, x and y the light of prediction and target, s sRGB's curve: a
    weighted least squares problem for each column c, by the normal equations' pseudoinverse.
    """
    x, y = (srgb_to_linear(colors.double()) for colors in (prediction, target))
    slopes = torch.where(y <= 0.0031308, 12.92, 1.055 / 2.4 * y.clamp(min=0.0031308) ** (1 / 2.4 - 1))
    rows = x[:, None, :] * slopes[:, :, None]  # [P, column, 3]
    products = torch.einsum("pci,pcj->cij", rows, rows)
    moments = torch.einsum("pci,pc->ci", rows, y * slopes)
    return (torch.linalg.pinv(products, hermitian=True) @ moments[..., None])[..., 0].T


def lit_views(
    predictions: Sequence[Float[Tensor, "h w 3"]],
    targets: Sequence[Float[Tensor, "h w 3"] | None],
    references: Sequence[Float[Tensor, "h w 3"]],
    masks: Sequence[Bool[Tensor, "h w"] | None],
    light: Light,
) -> list[Lit]:
    """All views of a test set in normal light.

    Args:
        predictions, targets: as rendered and as photographed, dark; ``None``: there is no photograph.
        references: the views in normal light.
        masks: which pixels count; ``None``: all do.
        light: light in which predictions and photographs are brightened.
    """
    rendered = [light.apply(prediction) for prediction in predictions]
    colors = fit_colors(rendered, references, masks)
    return [
        Lit(reference, image, None if target is None else light.apply(target), map_colors(image, colors))
        for reference, image, target in zip(references, rendered, targets, strict=True)
    ]


def fit_colors(
    images: Sequence[Float[Tensor, "h w 3"]],
    references: Sequence[Float[Tensor, "h w 3"]],
    masks: Sequence[Bool[Tensor, "h w"] | None],
) -> Float64[Tensor, "4 3"]:
    """The affine map of sRGB colours, one for all views, with the least squared error to the references.

    ``argmin_M sum |[c 1] M - r|^2`` over all pixels that count, by the normal equations' pseudoinverse: of the smallest
    M where colours leave it open. It sees the references: an oracle, which tells errors of colour from all others.
    """
    products, moments = torch.zeros(4, 4, dtype=torch.float64), torch.zeros(4, 3, dtype=torch.float64)
    for image, reference, mask in zip(images, references, masks, strict=True):
        colors = pixels_that_count(image, mask).double()
        rows = torch.cat([colors, torch.ones_like(colors[:, :1])], dim=1)
        products += rows.T @ rows
        moments += rows.T @ pixels_that_count(reference, mask).double()
    return torch.linalg.pinv(products, hermitian=True) @ moments


def map_colors(image: Float[Tensor, "h w 3"], colors: Float64[Tensor, "4 3"]) -> Float[Tensor, "h w 3"]:
    """Apply an affine map ``[4, 3]`` to an image's colours, clipped to [0, 1]."""
    return (image.double() @ colors[:3] + colors[3]).clamp(0.0, 1.0).to(image.dtype)
