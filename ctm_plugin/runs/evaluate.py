"""Rendering and scoring of a run's test views, after training or from its checkpoint."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ctm_plugin.backbones.base import Backbone
from ctm_plugin.color.settings import AUTO_LIGHT, LightConfig
from ctm_plugin.cpu.products import fast_products
from ctm_plugin.files import write_json
from ctm_plugin.metrics.evaluate import Scoring, is_measurement
from ctm_plugin.metrics.lpips import LPIPS
from ctm_plugin.metrics.lpips_weights import load_lpips
from ctm_plugin.runs.assemble import Parts
from ctm_plugin.runs.load import load_run
from ctm_plugin.runs.provenance import code_version, device_name, fingerprint, versions
from ctm_plugin.runs.rundir import METRICS
from ctm_plugin.runs.settings import LitConfig
from ctm_plugin.settings.build import Config
from ctm_plugin.show.bars import tracked
from ctm_plugin.show.console import print_summary

LITTLE_DETAIL = 0.25
"""Score ``detail`` below which a run warns: four runs that failed had 0.01 at most, eleven others 0.5 at least."""
SHORT_BUDGETS = ("smoke", "check", "quick")
"""Budgets too short for the warning of little detail."""


def score(
    module: Backbone, config: Config, folder: Path, lpips: tuple[LPIPS | None, str], steps: int,
    spent: dict[str, float], light: LightConfig = AUTO_LIGHT,
) -> dict[str, Any]:  # fmt: skip
    """Have a trained backbone score itself and write its pictures and ``metrics.json`` into ``folder``.

    Args:
        module, config: the run's backbone and configuration.
        folder: to write to.
        lpips: what :func:`ctm_plugin.metrics.lpips_weights.load_lpips` returned.
        steps, spent: steps, seconds and memory of its training, see :class:`ctm_plugin.runs.load.LoadedRun`.
        light: settings of the light in which pictures are displayed.

    Returns:
        The content of ``metrics.json``.
    """
    with fast_products(module.device):
        result = module.scores(folder, Scoring(config["dataset"], lpips, light, tracked))
    seconds = spent["seconds"]
    result |= {
        "measured": is_measurement(config),
        "steps": steps,
        "train_seconds": seconds,
        "rays_per_second": module.batches_seen / steps * module.rays(0, steps) / seconds if steps and seconds else None,
        "peak_memory_mb": spent["peak_memory_mb"],
        "backbone": config["backbone"]["name"],
        "ctm": config["ctm"].get("preset", config["ctm"]["name"]),
        "color_space": config["color_space"]["name"],
        "colors": module.transform.describe(),
        "appearance": config["appearance"]["name"],
        "pictures": module.appearance and module.appearance.describe(),
        "precision": config["trainer"]["precision"],
        "dataset": module.scene.name,
        "seed": config["seed"],
        "version": code_version(),
        "versions": versions(),
        "device": device_name(module.device),
        "data": fingerprint(module.scene),
    }
    write_json(folder / METRICS, result)
    warn_of_failed_views(result, config["trainer"].get("budget"))
    return result


def lpips_for(parts: Parts) -> tuple[LPIPS | None, str]:
    """Load LPIPS for a run, see :func:`load_lpips`; without a photographed test view nothing is downloaded."""
    settings, views = parts.metrics, parts.backbone.scene.test if parts.backbone.posed else None
    scored = views is not None and (views.pictured is None or bool(views.pictured.any()))
    if not scored and settings.lpips_weights is None:
        return None, "no test view with a picture"
    return load_lpips(settings.lpips_weights, settings.lpips_net)


def warn_of_failed_views(scores: Mapping[str, Any], budget: str | None) -> None:
    """Warn, with advice, where rendered lit views are worse than the brightened photographs.

    That is where views show little of the photographs' detail, or where there are lit references and both PSNR and SSIM
    prefer the photographs.
    """
    faults = []
    if (detail := scores.get("detail")) is not None and detail < LITTLE_DETAIL:
        faults.append(f"show {detail:.2f} of the real detail of their photographs, expected at least {LITTLE_DETAIL}")
    pairs = [(scores.get(name), scores.get(f"{name}_photo")) for name in ("psnr_lit", "ssim_lit")]
    if all(None not in pair and pair[0] < pair[1] for pair in pairs):
        faults.append("are farther from the references than the photographs in the same light")
    if faults:
        longer = "trainer=standard; if that does not help, " if budget in SHORT_BUDGETS else ""
        warnings.warn(
            f"the test views {' and '.join(faults)}: try {longer}other cameras (ctm cameras finds them) or another "
            "dataset.geometry",
            stacklevel=2,
        )


def evaluate(run: Path, light: LightConfig = AUTO_LIGHT, root: str | None = None) -> dict[str, Any]:
    """Score a run again from its configuration and checkpoint; writes ``RUN/evaluation/``.

    ``root`` is the folder of its data, see :func:`~ctm_plugin.runs.load.load_run`.

    Raises:
        CTMError: if the folder is no run, or its checkpoint cannot be used.
    """
    loaded = load_run(run, root)
    lpips = lpips_for(loaded.parts)
    (run / "evaluation").mkdir(exist_ok=True)
    return score(loaded.module, loaded.config, run / "evaluation", lpips, loaded.step, loaded.spent, light)


def command(run: Path, settings: LitConfig) -> None:
    """Score a run again, finished or interrupted, from its configuration and checkpoint.

    Writes pictures and ``metrics.json`` into ``RUN_DIR/evaluation``. Where the data set has the test views in normal
    light (``dataset.lit``), the lit views are scored against them. References are neither trained on nor fitted to.
    """
    print_summary(evaluate(run, settings, settings.dataset.root), run / "evaluation", run)
