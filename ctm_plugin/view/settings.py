"""The settings of the viewer; torch is not needed to check them."""

from __future__ import annotations

from dataclasses import dataclass

from ctm_plugin.runs.settings import LitConfig
from ctm_plugin.settings.setting import setting


@dataclass(frozen=True, kw_only=True)
class ViewConfig(LitConfig):
    """Address and first light of the viewer."""

    port: int = setting(8080, "port of the page", least=1, most=65535)
    host: str = setting(
        "127.0.0.1",
        "address to listen at; other addresses than 127.0.0.1, such as 0.0.0.0, let anyone look who has the "
        "printed address with its token",
    )
