"""Every number of a run that people read: an entry here is all that a metric needs.

Summaries compute what the entries say; the terminal, sweeps, the demo, reports, TensorBoard and the documentation read
names, directions and formats here. Entries stand in the order of ``metrics.json``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Float64
from torch import Tensor

from ctm_plugin.metrics.alignment import corner_errors, warp_errors
from ctm_plugin.metrics.depth import mean_absolute_error
from ctm_plugin.metrics.fitted import psnr_fitted
from ctm_plugin.metrics.image import pooled_psnr, psnr, psnr_enhanced, ssim, ssim_fits
from ctm_plugin.metrics.rendered import Alignment, View
from ctm_plugin.settings.registry import METRICS_OF_OTHERS

PLACES = ("run", "sweep", "report", "demo")
"""Where people read scores: the table of one run, the line of a run among others, reports, the demo's comparison."""


@dataclass(frozen=True, kw_only=True)
class Metric:
    """A number of a run.

    Attributes:
        label: its name for people.
        about: what it is, in a sentence without a full stop, for the documentation.
        higher: whether more is better.
        unit: behind the number.
        decimals: how many are printed.
        thousands: whether commas part them.
        view: of one test view, ``None`` where it cannot be computed; it goes into ``per_image``.
        lit: whether it is of views of which there is a picture in normal light (``View.lit``), not of those of which
            there is one as captured (``View.target``); runs without such pictures do not have it.
        views: of all test views; unless given, the mean of ``view``, and ``None`` where one view has none.
        alignment: of aligned patches; a number a patch, ``[n]``, goes into ``per_patch``, and its mean is the score.
        told: the :data:`PLACES` that show it.
        order: metrics with smaller numbers come first.
        brief: the label where there is little room; ``label`` unless given.
        curve: TensorBoard's tag and chart for it while a field trains, of a small rendering of one view.
        dark: whether only dark pictures have its curve.
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
        """Whether a test view has what this is of."""
        return (view.lit if self.lit else view.target) is not None

    @property
    def arrow(self) -> str:
        return "↑" if self.higher else "↓"

    @property
    def of(self) -> tuple[str, ...]:
        """Which scenes have it, of ``views`` and ``patches``; empty: it is of the training, and all runs have it."""
        kinds = {"views": self.view or self.views, "patches": self.alignment}
        return tuple(kind for kind, function in kinds.items() if function)

    def text(self, value: float) -> str:
        """A value with its unit."""
        number = f"{value:{',' if self.thousands else ''}.{self.decimals}f}"
        return f"{number} {self.unit}" if self.unit else number


def _pooled(views: Sequence[View], statistic: Callable[[Float64[Tensor, " pixels"]], float | None]) -> float | None:
    """A statistic of the depth errors of all views together."""
    errors = [view.depth_errors for view in views if view.depth_errors is not None]
    return statistic(torch.cat(errors)) if errors else None


def _ssim(prediction: Tensor, target: Tensor, mask: Tensor | None) -> float | None:
    return float(ssim(prediction, target, mask)) if ssim_fits(*target.shape[:2]) else None


def _lpips(prediction: Tensor, target: Tensor, view: View) -> float | None:
    """Pixels that do not count are the target's in both."""
    if view.lpips is None:
        return None
    return float(
        view.lpips(prediction if view.mask is None else prediction.where(view.mask[..., None], target), target)
    )


def of_lit(which: str, suffix: str, told: tuple[str, ...], label: str, about: str) -> dict[str, Metric]:
    """PSNR, SSIM and LPIPS of one of the pictures of :class:`~ctm_plugin.metrics.lit.Lit` against its reference."""

    def of(score: Callable[[Tensor, Tensor, View], float | None]) -> Callable[[View], float | None]:
        def of_view(view: View) -> float | None:
            image = getattr(view.lit, which)
            return None if image is None else score(image, view.lit.reference, view)

        return of_view

    return {
        f"psnr_lit{suffix}": Metric(
            label=f"PSNR, {label}", unit="dB", decimals=2, told=told, lit=True, order=2, about=f"PSNR of {about}",
            view=of(lambda image, reference, view: float(psnr(image, reference, view.mask))),
        ),
        f"ssim_lit{suffix}": Metric(
            label=f"SSIM, {label}", told=() if suffix else told, lit=True, order=2, about=f"SSIM of {about}",
            view=of(lambda image, reference, view: _ssim(image, reference, view.mask)),
        ),
        f"lpips_lit{suffix}": Metric(
            label=f"LPIPS, {label}", higher=False, told=() if suffix else told, lit=True, order=2,
            about=f"LPIPS of {about}", view=of(_lpips),
        ),
    }  # fmt: skip


METRICS: dict[str, Metric] = {
    "psnr": Metric(
        label="PSNR", unit="dB", decimals=2, order=0, told=PLACES,
        about="mean over views, or over patches, of the PSNR of each",
        view=lambda view: float(psnr(view.prediction, view.target, view.mask)),
        alignment=lambda found: psnr(found.rendered, found.clean),
        curve=("psnr/test_view", "PSNR of a test view"),
    ),
    "ssim": Metric(
        label="SSIM", told=PLACES,
        about="mean over views; Gaussian windows of 11 pixels that lie inside the picture",
        view=lambda view: _ssim(view.prediction, view.target, view.mask),
    ),
    "lpips": Metric(
        label="LPIPS", higher=False,
        about="mean over views, of the network that `lpips_net` names; else `lpips_reason` says why there is none",
        view=lambda view: _lpips(view.prediction, view.target, view),
    ),
    "psnr_enhanced": Metric(
        label="brightened PSNR", brief="brightened", unit="dB", decimals=2, order=0, told=PLACES,
        about="mean over views, both pictures brightened by `enhancement_gain`",
        view=lambda view: float(psnr_enhanced(view.prediction, view.target, view.gain, view.mask)),
        curve=("psnr/test_view_brightened", "PSNR of a test view, brightened"), dark=True,
    ),
    "psnr_fitted": Metric(
        label="PSNR, right half, light fitted to the left", brief="fitted", unit="dB", decimals=2, order=2,
        told=("run",), differing=True,
        about="mean over views of the PSNR of the right half, after the matrix of linear light that fits the left half "
        "best: what is left where a view was exposed in its own way",
        view=lambda view: psnr_fitted(view.prediction, view.target, view.mask),
    ),
    **of_lit(
        "rendered", "", ("run", "sweep", "report"), "lit",
        "the views, brightened by `light_factor`, against pictures of them in normal light",
    ),
    **of_lit(
        "photo", "_photo", ("run",), "lit photographs",
        "the dark photographs of the test views themselves, brightened by `light_factor`: what brightening can give",
    ),
    **of_lit(
        "fitted", "_fitted", ("run",), "lit, colours fitted to the references",
        "the lit views after the affine map of colours that fits the references best: an oracle",
    ),
    "depth_mae": Metric(
        label="depth error", higher=False, told=PLACES,
        about="mean over all pixels that show a surface of the error of the depth, in scene units",
        view=lambda view: None if view.depth_errors is None else mean_absolute_error(view.depth_errors),
        views=lambda views: _pooled(views, mean_absolute_error),
    ),
    "patch_psnr_pooled": Metric(
        label="patch PSNR", unit="dB", decimals=2, told=("report",),
        about="of all patches' pixels together, as BARF's code has it",
        alignment=lambda found: pooled_psnr(found.rendered, found.clean),
    ),
    "image_psnr": Metric(
        label="PSNR, whole picture", unit="dB", decimals=2, order=2, told=("run",),
        about="of the whole picture in the first patch's frame, which is its own",
        alignment=lambda found: psnr(found.fused, found.picture),
    ),
    "warp_error": Metric(
        label="warping error", higher=False,
        about="mean over patches of the distance of the homographies' eight parameters from the true ones",
        alignment=lambda found: warp_errors(found.warps, found.true_warps),
    ),
    "corner_error": Metric(
        label="corner error", higher=False, unit="pixels", decimals=2, told=("run",),
        about="mean over patches of how far their corners are from where they belong",
        alignment=lambda found: corner_errors(
            found.warps, found.true_warps, *found.picture.shape[:2], found.clean.shape[1]
        ),
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
    """Put the metrics of other packages behind ours: not on import, as these packages import this module.

    Raises:
        CTMError: one cannot be imported.
    """
    for name in METRICS_OF_OTHERS.names():
        METRICS.setdefault(name, METRICS_OF_OTHERS.get(name))


def told_at(place: str) -> dict[str, Metric]:
    """Find the metrics that one of :data:`PLACES` shows, in the order in which it shows them."""
    add_others()
    found = [(name, metric) for name, metric in METRICS.items() if place in metric.told]
    return dict(sorted(found, key=lambda item: item[1].order))
