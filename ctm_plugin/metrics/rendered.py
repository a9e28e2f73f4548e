"""Inputs of metrics: a rendered view with its photograph, aligned patches with their true homographies."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float, Float64
from torch import Tensor

from ctm_plugin.metrics.lpips import LPIPS


@dataclass(frozen=True)
class Lit:
    """A view photographed in normal light, and three estimates of that photograph. All in [0, 1].

    Attributes:
        reference: the photograph that was taken in normal light.
        rendered: the rendering, brightened by the scene's one light.
        photo: the view's dark photograph, brightened alike: the best that brightening can give; ``None`` where
            there is none.
        fitted: ``rendered`` after the colour map that fits the references best, an oracle: see
            :func:`ctm_plugin.metrics.fitted.fit_colors`.
    """

    reference: Float[Tensor, "h w 3"]
    rendered: Float[Tensor, "h w 3"]
    photo: Float[Tensor, "h w 3"] | None
    fitted: Float[Tensor, "h w 3"]


@dataclass(frozen=True)
class View:
    """A rendered test view.

    Attributes:
        prediction, target: decoded RGB and the photograph as captured, in [0, 1]; ``None`` where there is none: the
            metrics that compare with it are then left out.
        gain: factor by which ``psnr_enhanced`` brightens both, see :func:`ctm_plugin.color.light.enhancement_gain`.
        lpips: the LPIPS network; ``None`` where there is none, or the view is too small for it.
        depth_errors: absolute errors of pixels that show a surface, scene units; ``None`` where no depth is known.
        mask: which pixels count; ``None``: all do.
        lit: the view in normal light; ``None`` where there is no picture of it.
        detail: see :func:`ctm_plugin.metrics.detail.detail_moments`; ``None`` where there are none.
    """

    prediction: Float[Tensor, "h w 3"]
    target: Float[Tensor, "h w 3"] | None
    gain: float = 1.0
    lpips: LPIPS | None = None
    depth_errors: Float64[Tensor, " pixels"] | None = None
    mask: Bool[Tensor, "h w"] | None = None
    lit: Lit | None = None
    detail: Float64[Tensor, " 4"] | None = None


@dataclass(frozen=True)
class Alignment:
    """Patches of one picture that were aligned.

    Attributes:
        rendered, clean: the patches as rendered, and without noise.
        fused, picture: the whole picture as rendered, in the first patch's frame, and the true picture.
        warps, true_warps: learned and true parameters of the homographies.
        gain: factor that brightens the picture, see :func:`ctm_plugin.color.light.enhancement_gain`.
    """

    rendered: Float[Tensor, "n p p 3"]
    clean: Float[Tensor, "n p p 3"]
    fused: Float[Tensor, "h w 3"]
    picture: Float[Tensor, "h w 3"]
    warps: Float[Tensor, "n 8"]
    true_warps: Float[Tensor, "n 8"]
    gain: float
