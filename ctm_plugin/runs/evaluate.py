"""Render and score the test views; as a command, of a finished or interrupted run from its checkpoint."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ctm_plugin.backbones.base import Backbone
from ctm_plugin.bars import tracked
from ctm_plugin.color.settings import AUTO_LIGHT, LightConfig
from ctm_plugin.console import print_summary
from ctm_plugin.cpu.products import fast_products
from ctm_plugin.files import write_json
from ctm_plugin.metrics.evaluate import Scoring, is_measurement
from ctm_plugin.metrics.lpips import LPIPS
from ctm_plugin.metrics.lpips_weights import load_lpips
from ctm_plugin.runs.load import load_run
from ctm_plugin.runs.provenance import code_version, device_name, fingerprint, versions
from ctm_plugin.runs.settings import EvaluateConfig
from ctm_plugin.settings.build import Config


def score(
    module: Backbone,
    config: Config,
    folder: Path,
    lpips: tuple[LPIPS | None, str],
    light: LightConfig = AUTO_LIGHT,
) -> dict[str, Any]:
    """Have a trained backbone score itself and write its pictures into ``folder``.

    ``lpips`` is what :func:`ctm_plugin.metrics.lpips_weights.load_lpips` returned, ``light`` what
    lit pictures are shown in.
    """
    return module.scores(folder, Scoring(config["dataset"], lpips, light, tracked))


def run_figures(module: Backbone, config: Config, steps: int, seconds: float, peak_memory_mb: float) -> dict[str, Any]:
    """What ``metrics.json`` says of a run in addition to its scores."""
    return {
        "measured": is_measurement(config),
        "steps": steps,
        "train_seconds": seconds,
        "rays_per_second": module.batches_seen * module.batch_rays / seconds if seconds else None,
        "peak_memory_mb": peak_memory_mb,
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
        "data": fingerprint(getattr(module, "scene", None)),
    }


def evaluate(run: Path, light: LightConfig = AUTO_LIGHT, root: str | None = None) -> dict[str, Any]:
    """Score a run again from its configuration and checkpoint; writes ``RUN/evaluation/``.

    ``root`` is the folder of its data, see :func:`~ctm_plugin.runs.load.load_run`.

    Raises:
        CTMError: if the folder is no run, or its checkpoint cannot be used.
    """
    parts, config, checkpoint = load_run(run, root)
    lpips = load_lpips(parts.metrics.lpips_weights, parts.metrics.lpips_net)
    figures = run_figures(parts.backbone, config, checkpoint["global_step"], **checkpoint["callbacks"]["Stopwatch"])
    (run / "evaluation").mkdir(exist_ok=True)
    with fast_products(parts.backbone.device):
        result = score(parts.backbone, config, run / "evaluation", lpips, light) | figures
    write_json(run / "evaluation" / "metrics.json", result)
    return result


def command(run: Path, settings: EvaluateConfig) -> None:
    """Score a run again, finished or interrupted, from its configuration and checkpoint.

    Writes pictures and ``metrics.json`` into ``RUN_DIR/evaluation``. Where the data set has the test views in normal
    light (``dataset.lit``), the lit views are scored against them. References are neither trained on nor fitted to.
    """
    print_summary(evaluate(run, settings, settings.dataset.root), run / "evaluation", run)
