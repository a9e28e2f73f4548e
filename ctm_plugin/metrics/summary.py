"""All scores of a test set as one plain dict, ready for JSON."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from statistics import fmean
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ctm_plugin.errors import CTMError
from ctm_plugin.metrics.depth import mean_absolute_error, median_error, surface_errors
from ctm_plugin.metrics.enhance import enhancement_gain, psnr_enhanced
from ctm_plugin.metrics.image import best_constant_psnr, converged, psnr, ssim, ssim_fits
from ctm_plugin.metrics.lpips import LPIPS

Images = Float[Tensor, "n h w 3"] | Sequence[Float[Tensor, "h w 3"]]
Depths = Float[Tensor, "n h w"] | Sequence[Float[Tensor, "h w"]]
Masks = Bool[Tensor, "n h w"] | Sequence[Bool[Tensor, "h w"]]


@torch.no_grad()
def summarize(
    names: Sequence[str],
    predictions: Images,
    targets: Images,
    exposure: float | None,
    depths: Depths | None = None,
    true_depths: Depths | None = None,
    masks: Masks | None = None,
    lpips: tuple[LPIPS | None, str] = (None, "not asked for"),
) -> dict[str, Any]:
    """Score a test set.

    Image scores are means over images of per-image scores; depth scores pool all pixels that show a surface.

    Args:
        names: one name a view.
        predictions: decoded RGB, ``[N, H, W, 3]`` in [0, 1], or a sequence of ``[H, W, 3]``.
        targets: the images as captured, the same shapes.
        exposure: light relative to a normal exposure, ``None`` where it is not known.
        depths, true_depths: distances along the ray in scene units, ``[N, H, W]``; NaN in ``true_depths``: no surface.
            Depth is scored where both are given.
        masks: pixels whose depth counts, ``[N, H, W]``, all by default.
        lpips: what :func:`ctm_plugin.metrics.lpips_weights.load_lpips` returned.

    Returns:
        ``psnr, ssim, lpips, psnr_enhanced, constant_psnr`` (floats), ``lpips_net`` and ``lpips_reason`` (``None`` when
        LPIPS was computed), ``enhancement_gain``, ``depth_mae`` and ``depth_median``, ``converged`` and ``per_image``,
        a list of dicts of ``name, psnr, ssim, lpips, psnr_enhanced, depth_mae``. A number that was not computed, NaN
        or infinite is ``None``; the PSNR of exactly equal images is such a case.

    Raises:
        CTMError: there are no images.
    """
    if len(targets) == 0:
        raise CTMError("metrics: found no test images, expected at least one")
    height, width = targets[0].shape[:2]
    model, reason = lpips
    if model is not None and not model.fits(height, width):
        model, reason = None, f"images of {height}x{width} pixels are smaller than LPIPS' {model.min_size}"
    with_ssim = ssim_fits(height, width)
    gain = enhancement_gain(targets, exposure)
    constant = best_constant_psnr(targets)

    rows: list[dict[str, Any]] = []
    errors: list[Tensor] = []
    for index, (name, prediction, target) in enumerate(zip(names, predictions, targets, strict=True)):
        row: dict[str, Any] = {
            "name": name,
            "psnr": float(psnr(prediction, target)),
            "ssim": float(ssim(prediction, target)) if with_ssim else None,
            "lpips": float(model(prediction, target)) if model is not None else None,
            "psnr_enhanced": float(psnr_enhanced(prediction, target, gain)),
            "depth_mae": None,
        }
        if depths is not None and true_depths is not None:
            mask = masks[index] if masks is not None else None
            errors.append(surface_errors(depths[index], true_depths[index], mask))
            row["depth_mae"] = mean_absolute_error(errors[-1])
        rows.append(row)

    mean_psnr = fmean(row["psnr"] for row in rows)
    pooled = torch.cat(errors) if errors else None
    return {
        "psnr": _number(mean_psnr),
        "ssim": _mean(rows, "ssim"),
        "lpips": _mean(rows, "lpips"),
        "lpips_net": model.net if model is not None else None,
        "lpips_reason": reason if model is None else None,
        "psnr_enhanced": _mean(rows, "psnr_enhanced"),
        "enhancement_gain": gain,
        "depth_mae": _pooled(mean_absolute_error, pooled),
        "depth_median": _pooled(median_error, pooled),
        "converged": converged(mean_psnr, constant),
        "constant_psnr": _number(constant),
        "per_image": [{key: _number(value) for key, value in row.items()} for row in rows],
    }


def _mean(rows: list[dict[str, Any]], key: str) -> float | None:
    values = [row[key] for row in rows]
    return None if None in values else _number(fmean(values))


def _pooled(statistic: Callable[[Tensor], float | None], errors: Tensor | None) -> float | None:
    return None if errors is None else _number(statistic(errors))


def _number(value: Any) -> Any:
    """JSON has no NaN and no infinity: ``None`` instead. Anything but a float passes."""
    return None if isinstance(value, float) and not math.isfinite(value) else value
