"""Choice of picture width and budget so that splats are trained in time, by timing real steps."""

from __future__ import annotations

import math
import time
from typing import NamedTuple

import torch
from torch import nn

from ctm_plugin.backbones.splat import Splat
from ctm_plugin.callbacks.deadline import MIN_STRETCH
from ctm_plugin.color.transform import fitted
from ctm_plugin.draws import Draws
from ctm_plugin.runs.assemble import Parts

BUDGET_STEPS = {"standard": 2500, "quick": 1500}
"""Number of training steps of splats by budget."""
COLUMNS = {"standard": 300, "quick": 160}
"""Least width of pictures in pixels, by budget, for which the budget is worth its time."""
MAX_COLUMNS = 1600
"""Largest width in pixels: more show no more than a few minutes can learn."""
TIMED_COLUMNS = 300
"""Width in pixels of the pictures whose steps are timed."""
WARMUP_STEPS, TIMED_STEPS = 3, 8
"""Steps that allocate memory, and steps under the clock."""
FIXED_PIXELS = 38_000
"""Cost of a step on an empty picture, in pixels."""
MIDDLE_COST = 1.4
"""Cost of a step in the middle of a training, in units of :meth:`Splat.cost`."""
TIMED_GAUSSIANS, TIMED_SIGMA = 15_000, 0.009
"""Number of Gaussians when steps are timed, and their standard deviation on the picture, in its widths."""
SERIAL_SHARE = 0.5
"""Share of a step that does not run in parallel."""
WIDER_FACTOR = 1.6
"""Factor on the width whose time is printed as an alternative."""


class Timed(NamedTuple):
    """Mean seconds of a training step on one thread, and the pixels of the pictures that it was timed on."""

    seconds: float
    pixels: int


REFERENCE = Timed(0.04, 300 * 225)
"""Timing of a machine that was measured once, for machines that are not timed."""


class Plan(NamedTuple):
    """Picture width and budget of a training, and a line that explains them, which may be empty."""

    width: int
    budget: str
    told: str = ""


def timed_steps(parts: Parts) -> Timed:
    """Time training steps on one thread, by the processor's clock, which does not count what other programs take.

    The number and size of the Gaussians are those in the middle of a training.
    """
    module, threads = parts.backbone, torch.get_num_threads()
    fitted(module.transform, module.some_colors())
    module.on_train_start()
    _grow(module)
    optimizers = module.configure_optimizers()
    torch.set_num_threads(1)
    try:
        for step in range(WARMUP_STEPS + TIMED_STEPS):
            if step == WARMUP_STEPS:
                start = time.thread_time()
            optimizers.zero_grad()
            module.training_step(None, 0)["loss"].backward()
            optimizers.step()
        seconds = (time.thread_time() - start) / TIMED_STEPS * module.cost(0, module.schedule_steps) / MIDDLE_COST
    finally:
        torch.set_num_threads(threads)
    return Timed(seconds, parts.scene.train.height * parts.scene.train.width)


@torch.no_grad()
def _grow(module: Splat) -> None:
    """Give a module Gaussians at random places between its initial ones, of the size of trained Gaussians."""
    draws, views, tables = Draws(module.seed, 0, stream="plan"), module.scene.train, module.gaussians
    one, other = (draws.integers(len(tables.means), TIMED_GAUSSIANS) for _ in range(2))
    means = tables.means[one].lerp(tables.means[other], 0.01)
    distances = (means - views.c2w[0, :, 3]).norm(dim=1, keepdim=True)
    sizes = TIMED_SIGMA * views.width * distances / views.intrinsics[0, 0]
    grown = tables._replace(
        means=means,
        scales=sizes.log() + 0.6 * draws.normal(TIMED_GAUSSIANS, 3),
        quats=draws.normal(TIMED_GAUSSIANS, 4),
        opacities=1.5 * draws.normal(TIMED_GAUSSIANS, 1),
        sh0=tables.sh0[one],
        shN=tables.shN[one],
    )
    module.tables.update({name: nn.Parameter(table) for name, table in grown._asdict().items()})
    module.grad2d, module.grad2d_count = torch.zeros(TIMED_GAUSSIANS), torch.zeros(TIMED_GAUSSIANS)


def plan(
    size: tuple[int, int], minutes: int | float, timed: Timed | None, threads: int = 1, given: bool = False
) -> Plan:
    """Choose the pictures' width and the budget with which splats are trained in ``minutes``.

    Args:
        size: height and width of the photographs.
        minutes: time of the training.
        timed: how long a step takes here; ``None`` on a GPU, which has time for any.
        threads: number of threads on which loops run.
        given: whether the width is fixed by the user.
    """
    width = size[1]
    limit = width if given else min(width, MAX_COLUMNS)
    if timed is None:
        return Plan(limit, "standard")
    for budget in BUDGET_STEPS:
        columns = width if given else min(limit, max(_columns(size, minutes, budget, timed, threads), COLUMNS["quick"]))
        predicted = _minutes(size, columns, budget, timed, threads)
        if columns >= COLUMNS[budget] and (predicted < 2 * minutes or budget == "quick"):
            break
    if predicted * MIN_STRETCH > minutes:
        advice = f"minutes={minutes:g} is too short here: it takes about {predicted * MIN_STRETCH:.2g} minutes"
    elif columns < width:
        wider = min(width, math.ceil(WIDER_FACTOR * columns / 100) * 100)
        more = math.ceil(_minutes(size, wider, "standard" if wider >= COLUMNS["standard"] else "quick", timed, threads))
        advice = f"{wider} pixels wide would take about {more} minutes: dataset.width={wider} minutes={more}"
    else:
        advice = ""
    return Plan(columns, budget, advice)


def _seconds(pixels: int | float, timed: Timed, threads: int) -> float:
    """Guess the mean seconds of a training step on pictures of ``pixels``."""
    shared = SERIAL_SHARE + (1 - SERIAL_SHARE) / threads
    return shared * timed.seconds * (pixels + FIXED_PIXELS) / (timed.pixels + FIXED_PIXELS)


def _minutes(size: tuple[int, int], columns: int, budget: str, timed: Timed, threads: int) -> float:
    height, width = size
    return BUDGET_STEPS[budget] * _seconds(columns**2 * height / width, timed, threads) / 60


def _columns(size: tuple[int, int], minutes: int | float, budget: str, timed: Timed, threads: int) -> int:
    height, width = size
    pixels = 60 * minutes / BUDGET_STEPS[budget] / _seconds(1 - FIXED_PIXELS, timed, threads) - FIXED_PIXELS
    return round(math.sqrt(max(pixels, 0) * width / height))
