"""Every number of a run that people read: an entry here is all that a metric needs.

Summaries compute what the entries say; the terminal, sweeps, the demo, reports, TensorBoard and the documentation read
names, directions and formats here. Entries stand in the order of ``metrics.json``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.color.light import brighten
from ctm_plugin.metrics.detail import detail
from ctm_plugin.metrics.fitted import psnr_fitted
from ctm_plugin.metrics.image import psnr, ssim, ssim_fits
from ctm_plugin.metrics.rendered import Alignment, View
from ctm_plugin.rays.homography import patch_corners, sl3_exp, to_pixels, warp
from ctm_plugin.settings.registry import METRICS_OF_OTHERS

PLACES = ("run", "sweep", "report", "demo")
"""Where people read scores: the table of one run, its line in a sweep, reports, the demo's comparison."""


@dataclass(frozen=True, kw_only=True)
class Metric:
    """A metric: a number of a run, how it is computed, and where it is printed.

    Attributes:
        label: its name for people.
        about: what the metric is, in a sentence without a full stop, for the documentation.
        higher: whether more is better.
        unit: unit printed behind the number.
        decimals: how many are printed.
        thousands: whether commas separate thousands.
        view: computes the number of one test view, ``None`` where it cannot; it goes into ``per_image``.
        lit: whether it scores views that have a photograph in normal light (``View.lit``), not those that have one as
            captured (``View.target``); runs without such photographs do not have it.
        views: computes the number of all test views; by default the mean of ``view``, ``None`` where a view has none.
        alignment: computes a number for each aligned patch, ``[n]``, for ``per_patch``; the mean is the score.
        told: the :data:`PLACES` that show it.
        order: metrics with smaller numbers come first.
        brief: the label where there is little room; ``label`` unless given.
        curve: TensorBoard's tag and chart of the metric while a field trains, of a small rendering of one view.
        dark: whether only dark pictures have the metric's curve.
        differing: whether a run shows it only where its photographs differ (``appearance``).
    """

    label: str
    about: str
    higher: bool = True
    unit: str = ""
    decimals: int = 4
    thousands: bool = False
    view: Callable[[View], float | None] | None = None
    lit: bool = False
    views: Callable[[Sequence[View]], float | None] | None = None
    alignment: Callable[[Alignment], Tensor] | None = None
    told: tuple[str, ...] = ("run", "sweep", "report")
    order: int = 1
    brief: str = ""
    curve: tuple[str, str] | None = None
    dark: bool = False
    differing: bool = False

    def counts(self, view: View) -> bool:
        """Whether a test view has the photograph that the metric compares with."""
        return (view.lit if self.lit else view.target) is not None

    @property
    def arrow(self) -> str:
        return "↑" if self.higher else "↓"

    @property
    def of(self) -> tuple[str, ...]:
        """Kinds of scenes that have the metric, ``views`` or ``patches``; empty: all runs have it, as of training."""
        kinds = {"views": self.view or self.views, "patches": self.alignment}
        return tuple(kind for kind, function in kinds.items() if function)

    def text(self, value: float) -> str:
        """Format a value of the metric with its unit."""
        number = f"{value:{',' if self.thousands else ''}.{self.decimals}f}"
        return f"{number} {self.unit}" if self.unit else number


def corner_errors(alignment: Alignment) -> Float[Tensor, " n"]:
    """Mean distance of each patch's four corners from their true positions, in pixels of the picture."""
    height, width = alignment.picture.shape[:2]
    corners = patch_corners(height, width, alignment.clean.shape[1]).to(alignment.warps)
    at, belongs = (to_pixels(warp(corners, sl3_exp(h)), height, width) for h in (alignment.warps, alignment.true_warps))
    return (at - belongs).norm(dim=-1).mean(-1)


def _depth_error(views: Sequence[View]) -> float | None:
    errors = [view.depth_errors for view in views if view.depth_errors is not None and len(view.depth_errors)]
    return float(torch.cat(errors).mean()) if errors else None


def _detail(views: Sequence[View]) -> float | None:
    return detail([view.detail for view in views if view.detail is not None])


def _psnr(prediction: Tensor, target: Tensor, view: View) -> float:
    return float(psnr(prediction, target, view.mask))


def _ssim(prediction: Tensor, target: Tensor, view: View) -> float | None:
    return float(ssim(prediction, target, view.mask)) if ssim_fits(*target.shape[:2]) else None


def _lpips(prediction: Tensor, target: Tensor, view: View) -> float | None:
    """LPIPS of a view, with masked pixels replaced by the target's; ``None`` without a network."""
    if view.lpips is None:
        return None
    counted = prediction if view.mask is None else prediction.where(view.mask[..., None], target)
    return float(view.lpips(counted, target))


def of_lit(which: str, suffix: str, told: tuple[str, ...], label: str, about: str) -> dict[str, Metric]:
    """PSNR, SSIM and LPIPS entries of a picture of :class:`~ctm_plugin.metrics.rendered.Lit` against the reference."""

    def entry(name: str, score: Callable[[Tensor, Tensor, View], float | None], **more: Any) -> Metric:
        def of_view(view: View) -> float | None:
            image = getattr(view.lit, which)
            return None if image is None else score(image, view.lit.reference, view)

        text = {"label": f"{name}, {label}", "about": f"{name} of {about}"}
        return Metric(
            **text, **more, view=of_view, lit=True, order=2, told=told if name == "PSNR" or suffix != "_fitted" else ()
        )

    return {
        f"psnr_lit{suffix}": entry("PSNR", _psnr, unit="dB", decimals=2),
        f"ssim_lit{suffix}": entry("SSIM", _ssim),
        f"lpips_lit{suffix}": entry("LPIPS", _lpips, higher=False),
    }


METRICS: dict[str, Metric] = {
    "psnr": Metric(
        label="PSNR", unit="dB", decimals=2, order=0, told=PLACES,
        about="mean over views, or over patches, of the PSNR of each",
        view=lambda view: _psnr(view.prediction, view.target, view),
        alignment=lambda found: psnr(found.rendered, found.clean),
        curve=("psnr/test_view", "PSNR of a test view"),
    ),
    "ssim": Metric(
        label="SSIM", told=PLACES,
        about="mean over views; Gaussian windows of 11 pixels that lie inside the picture",
        view=lambda view: _ssim(view.prediction, view.target, view),
    ),
    "lpips": Metric(
        label="LPIPS", higher=False,
        about="mean over views, of the network that `lpips_net` names; else `lpips_reason` says why there is none",
        view=lambda view: _lpips(view.prediction, view.target, view),
    ),
    "psnr_enhanced": Metric(
        label="brightened PSNR", brief="brightened", unit="dB", decimals=2, order=0, told=("report", "demo"),
        about="mean over views, both pictures brightened by `enhancement_gain`",
        view=lambda view: _psnr(
            *(brighten(each.double(), view.gain, "hard") for each in (view.prediction, view.target)), view
        ),
        curve=("psnr/test_view_brightened", "PSNR of a test view, brightened"), dark=True,
    ),
    "psnr_fitted": Metric(
        label="PSNR, right half, light fitted to the left", brief="fitted", unit="dB", decimals=2, order=2,
        told=("run",), differing=True,
        about="mean over views of the PSNR of the right half, after the matrix of linear light that fits the left half "
        "best: what is left where a view was exposed in its own way",
        view=lambda view: psnr_fitted(view.prediction, view.target, view.mask),
    ),
    "detail": Metric(
        label="detail", decimals=2, order=2, told=("run",),
        about="share of the real fine detail of the test photographs, their noise left out, that lit views show: "
        "1 is all of it",
        view=lambda view: _detail([view]),
        views=_detail,
    ),
    **of_lit(
        "rendered", "", ("run", "sweep", "report"), "lit",
        "the lit views against pictures of them in normal light",
    ),
    **of_lit(
        "photo", "_photo", ("run",), "photographs in the same light",
        "the dark photographs of the test views themselves in the same light: what light can give",
    ),
    **of_lit(
        "fitted", "_fitted", ("run",), "lit, colours fitted to the references",
        "the lit views after the affine map of colours that fits the references best: an oracle",
    ),
    "depth_mae": Metric(
        label="depth error", higher=False, told=PLACES,
        about="mean over all pixels that show a surface of the error of the depth, in scene units",
        view=lambda view: _depth_error([view]),
        views=_depth_error,
    ),
    "patch_psnr_pooled": Metric(
        label="patch PSNR", unit="dB", decimals=2, told=("report",),
        about="of all patches' pixels together, as BARF's code has it",
        alignment=lambda found: psnr(found.rendered.flatten(0, 1), found.clean.flatten(0, 1)),
    ),
    "image_psnr": Metric(
        label="PSNR, whole picture", unit="dB", decimals=2, order=2, told=("run",),
        about="of the whole picture in the first patch's frame, which is its own",
        alignment=lambda found: psnr(found.fused, found.picture),
    ),
    "warp_error": Metric(
        label="warping error", higher=False,
        about="mean over patches of the distance of the homographies' eight parameters from the true ones",
        alignment=lambda found: (found.warps - found.true_warps).norm(dim=-1),
    ),
    "corner_error": Metric(
        label="corner error", higher=False, unit="pixels", decimals=2, told=("run",),
        about="mean over patches of how far their corners are from where they belong",
        alignment=corner_errors,
    ),
    "train_seconds": Metric(
        label="training", higher=False, unit="s", decimals=0, order=3, told=PLACES,
        about="of the training, evaluation left out",
    ),
    "rays_per_second": Metric(
        label="rays per second", decimals=0, thousands=True, order=3, told=("run",),
        about="training pixels a second",
    ),
    "peak_memory_mb": Metric(
        label="peak memory", higher=False, unit="MiB", decimals=0, thousands=True, order=3, told=("run",),
        about="of the GPU, or of the process on a CPU",
    ),
}  # fmt: skip


@cache
def add_others() -> None:
    """Add the metrics of other packages to ``METRICS``: not on import, as these packages import this module.

    Raises:
        CTMError: one cannot be imported.
    """
    for name in METRICS_OF_OTHERS.names():
        METRICS.setdefault(name, METRICS_OF_OTHERS.get(name))


def told_at(place: str) -> dict[str, Metric]:
    """Find the metrics that one of :data:`PLACES` shows, in the order in which it shows them."""
    add_others()
    metrics = [(name, metric) for name, metric in METRICS.items() if place in metric.told]
    return dict(sorted(metrics, key=lambda item: item[1].order))
