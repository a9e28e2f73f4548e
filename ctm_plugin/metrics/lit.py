"""Lit views: what was rendered in the dark, brightened, compared with pictures of the same views in normal light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from ctm_plugin.color.light import brighten
from ctm_plugin.metrics.image import pixels_that_count


@dataclass(frozen=True)
class Lit:
    """One view in normal light, and three tries at it. All in [0, 1].

    Attributes:
        reference: the picture that was taken in normal light.
        rendered: the rendering, brightened by the one factor.
        photo: the dark photograph of the view itself, brightened by it: what brightening can give; ``None`` where
            there is none.
        fitted: ``rendered`` after the colour map that fits the references best, an oracle: see :func:`fit_colors`.
    """

    reference: Float[Tensor, "h w 3"]
    rendered: Float[Tensor, "h w 3"]
    photo: Float[Tensor, "h w 3"] | None
    fitted: Float[Tensor, "h w 3"]


def lit_views(
    predictions: Sequence[Float[Tensor, "h w 3"]],
    targets: Sequence[Float[Tensor, "h w 3"] | None],
    references: Sequence[Float[Tensor, "h w 3"]],
    masks: Sequence[Bool[Tensor, "h w"] | None],
    factor: float,
) -> list[Lit]:
    """All views of a test set in normal light.

    Args:
        predictions, targets: as rendered and as photographed, dark; ``None``: there is no photograph.
        references: the views in normal light.
        masks: which pixels count; ``None``: all do.
        factor: on linear light, found from the training pictures (:func:`ctm_plugin.color.light.auto_factor`).
    """
    rendered = [brighten(prediction, factor) for prediction in predictions]
    colors = fit_colors(rendered, references, masks)
    return [
        Lit(reference, image, None if target is None else brighten(target, factor), map_colors(image, colors))
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
    """An affine map of colours, clipped to [0, 1]."""
    return (image.double() @ colors[:3] + colors[3]).clamp(0.0, 1.0).to(image.dtype)
