"""Settings of scores; torch is not needed to check them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ctm_plugin.settings.setting import Settings, setting


@dataclass(frozen=True, kw_only=True)
class MetricsConfig(Settings, section="metrics"):
    """Scores of test views."""

    lpips_weights: str | Path | None = setting(
        None, "file (.npz or .pth) with AlexNet's or VGG's convolutions; null: torch.hub's cache, else a download"
    )
    lpips_net: str = setting("alex", "network that LPIPS compares with: alex or vgg", choices=("alex", "vgg"))
