"""Scores of a test set, or of aligned patches, as one plain dict, ready for JSON."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import fmean
from typing import Any

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from ctm_plugin.color.light import AS_IS, Light, enhancement_gain
from ctm_plugin.color.settings import AUTO_LIGHT, LightConfig
from ctm_plugin.metrics.fitted import lit_views
from ctm_plugin.metrics.image import best_constant_psnr, converged, pixels_that_count
from ctm_plugin.metrics.lpips import LPIPS
from ctm_plugin.metrics.rendered import Alignment, View
from ctm_plugin.metrics.table import METRICS, Metric

Images = Float[Tensor, "n h w 3"] | Sequence[Float[Tensor, "h w 3"]]
Depths = Float[Tensor, "n h w"] | Sequence[Float[Tensor, "h w"]]


@dataclass(frozen=True)
class Scoring:
    """Metrics, data settings and light that a backbone scores itself with.

    Attributes:
        dataset: the data set's section of the run's configuration, for the ``protocol`` of the scores.
        lpips: what :func:`ctm_plugin.metrics.lpips_weights.load_lpips` returned.
        light: light that pictures are displayed in, see :func:`ctm_plugin.color.light.chosen_light`.
        track: ``track(items, what)`` gives the items back and shows how many are done; by default it shows nothing.
    """

    dataset: Mapping[str, Any] = field(default_factory=dict)
    lpips: tuple[LPIPS | None, str] = (None, "not asked for")
    light: LightConfig = AUTO_LIGHT
    track: Callable[[Iterable[Any], str], Iterable[Any]] = lambda items, what: items


@torch.no_grad()
def summarize(
    names: Sequence[str],
    predictions: Images,
    targets: Sequence[Float[Tensor, "h w 3"] | None] | Images,
    exposure: float | None,
    depths: Depths | None = None,
    true_depths: Depths | None = None,
    lpips: tuple[LPIPS | None, str] = (None, "not asked for"),
    masks: Sequence[Bool[Tensor, "h w"]] | None = None,
    references: Images | None = None,
    light: Light = AS_IS,
    details: Sequence[Float64[Tensor, " 4"] | None] | None = None,
) -> dict[str, Any]:
    """Score a test set.

    Image scores are means of per-image scores over the views that have a picture; depth scores pool all pixels that
    show a surface.

    Args:
        names: one name a view, of at least one.
        predictions: decoded RGB, ``[N, H, W, 3]`` in [0, 1], or a sequence of ``[H, W, 3]``.
        targets: the images as captured, the same shapes; ``None`` for a view without a photograph.
        exposure: light relative to a normal exposure, ``None`` where it is not known.
        depths, true_depths: distances along the ray in scene units, ``[N, H, W]``; NaN in ``true_depths``: no surface.
            Depth is scored where both are given.
        lpips: what :func:`ctm_plugin.metrics.lpips_weights.load_lpips` returned.
        masks: which pixels count, ``[H, W]`` a view; ``None``: all do.
        references: the views in normal light, of the predictions' shapes, where there are such pictures.
        light: light in which predictions are compared with the references.
        details: of each view, see :func:`ctm_plugin.metrics.detail.detail_moments`; ``None``: detail is not scored.

    Returns:
        What :data:`~ctm_plugin.metrics.table.METRICS` has of views, ``lpips_net`` and ``lpips_reason`` (``None`` when
        LPIPS was computed), ``enhancement_gain``, ``converged``, ``constant_psnr`` and ``per_image``, a list of dicts
        of ``name`` and what there is of a view. A number that was not computed, NaN or infinite is ``None``; the PSNR
        of exactly equal images is such a case. Without pictures as captured all of theirs are ``None``, ``converged``
        too; without references the scores of lit views are left out.
    """
    height, width = predictions[0].shape[:2]
    model, reason = lpips
    if model is not None and not model.fits(height, width):
        model, reason = None, f"images of {height}x{width} pixels are smaller than LPIPS' {model.min_size}"
    none = [None] * len(predictions)
    masks = none if masks is None else masks
    captured = [(target, mask) for target, mask in zip(targets, masks, strict=True) if target is not None]
    gain = constant = None
    if captured:
        gain = enhancement_gain([pixels_that_count(*each) for each in captured], exposure)
        constant = best_constant_psnr(*zip(*captured, strict=True))
    errors = lit = none
    if depths is not None and true_depths is not None:
        errors = list(map(_depth_errors, depths, true_depths, masks))
    if references is not None:
        lit = lit_views(list(predictions), list(targets), list(references), masks, light)
    views = [
        View(prediction, target, gain or 1.0, model, *of_view)
        for prediction, target, *of_view in zip(predictions, targets, errors, masks, lit, details or none, strict=True)
    ]
    metrics = {
        name: metric
        for name, metric in METRICS.items()
        if "views" in metric.of and (references is not None or not metric.lit)
    }
    of_each = {
        name: [metric.view(view) if metric.counts(view) else None for view in views]
        for name, metric in metrics.items()
        if metric.view
    }
    scores = {name: _of_all(metric, views, of_each.get(name)) for name, metric in metrics.items()}
    return {
        **{name: _number(value) for name, value in scores.items()},
        "lpips_net": None if model is None else model.net,
        "lpips_reason": reason if model is None else None,
        "enhancement_gain": gain,
        "converged": None if constant is None else converged(scores["psnr"], constant),
        "constant_psnr": _number(constant),
        "per_image": [
            {"name": name} | {metric: _number(values[index]) for metric, values in of_each.items()}
            for index, name in enumerate(names)
        ],
    }


@torch.no_grad()
def summarize_alignment(alignment: Alignment) -> dict[str, Any]:
    """Score aligned patches.

    Returns:
        What :data:`~ctm_plugin.metrics.table.METRICS` has of patches, ``constant_psnr``, ``enhancement_gain``,
        ``converged`` and ``per_patch``, a list of dicts of ``patch`` and what there is of each. Numbers that are NaN or
        infinite are ``None``.
    """
    constant = best_constant_psnr(list(alignment.clean))
    results = {name: metric.alignment(alignment) for name, metric in METRICS.items() if metric.alignment}
    scores = {name: float(result.mean()) for name, result in results.items()}
    of_each = {name: result.tolist() for name, result in results.items() if result.ndim}
    return {
        **{name: _number(value) for name, value in scores.items()},
        "constant_psnr": _number(constant),
        "enhancement_gain": alignment.gain,
        "converged": converged(scores["psnr"], constant),
        "per_patch": [
            {"patch": index} | {name: _number(values[index]) for name, values in of_each.items()}
            for index in range(len(alignment.clean))
        ],
    }


def is_measurement(config: Mapping[str, Any]) -> bool:
    """Whether scores of a run's configuration mean something: ``trainer=smoke`` is a test of the command."""
    return config["trainer"].get("budget") != "smoke"


def no_measurement(steps: int | str) -> str:
    """The remark that scores after so few steps mean nothing."""
    return f"{steps} steps: a test of the command, not a measurement"


def _depth_errors(depth: Tensor, true: Tensor, mask: Tensor | None) -> Float64[Tensor, " pixels"]:
    """Absolute depth errors of the pixels that count and show a surface, in scene units."""
    counted = true.isfinite() if mask is None else true.isfinite() & mask
    return (depth[counted].double() - true[counted].double()).abs()


def _of_all(metric: Metric, views: Sequence[View], of_each: Sequence[float | None] | None) -> float | None:
    counted = [index for index, view in enumerate(views) if metric.counts(view)]
    if metric.views is not None:
        return metric.views([views[index] for index in counted])
    values = [of_each[index] for index in counted]
    return None if not values or None in values else fmean(values)


def _number(value: float | None) -> float | None:
    """Replace NaN and infinity, which JSON has not, by ``None``."""
    return value if value is not None and math.isfinite(value) else None
