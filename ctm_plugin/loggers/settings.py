"""The settings of all loggers; their packages are not needed to check them."""

from __future__ import annotations

from dataclasses import dataclass

from ctm_plugin.settings.setting import Settings, setting


@dataclass(frozen=True, kw_only=True)
class WandBConfig(Settings, section="logger"):
    """Project and mode of Weights & Biases."""

    project: str = setting("ctm_plugin", "project that runs are put into")
    mode: str = setting(
        "offline", "offline: files for `wandb sync`; online: straight to the service", choices=("offline", "online")
    )
    group: str | None = setting(None, "name of a group of runs; null: a sweep's folder, and no group for single runs")


@dataclass(frozen=True, kw_only=True)
class MLflowConfig(Settings, section="logger"):
    """Settings of MLflow: where runs go."""

    experiment: str = setting("ctm_plugin", "experiment that runs are put into")
