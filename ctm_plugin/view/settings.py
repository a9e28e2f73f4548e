"""Settings of the viewer; torch is not needed to check them."""

from __future__ import annotations

from dataclasses import dataclass

from ctm_plugin.runs.settings import LitConfig
from ctm_plugin.settings.setting import setting


@dataclass(frozen=True, kw_only=True)
class ViewConfig(LitConfig):
    """Port and first light of the viewer."""

    port: int = setting(8080, "port of the page", least=1, most=65535)
