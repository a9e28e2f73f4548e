"""The settings of the viewer; torch is not needed to check them."""

from __future__ import annotations

from dataclasses import dataclass

from ctm_plugin.runs.settings import LitConfig
from ctm_plugin.settings.setting import setting

SIZES = (64, 4096)
"""Least and most pixels along a finest picture's longer side."""
MOST_SECONDS = 600


@dataclass(frozen=True, kw_only=True)
class ViewConfig(LitConfig):
    """Where to listen, and how to look."""

    port: int = setting(8080, "port of the page", least=1, most=65535)
    host: str = setting(
        "127.0.0.1",
        "address to listen at; other addresses than 127.0.0.1, such as 0.0.0.0, let anyone look who has the "
        "printed address with its token",
    )
    light: str = setting(
        "auto", "light that the sliders start with: auto (found from the training pictures), a number of stops, or off"
    )
    size: int | None = setting(
        None,
        "longer side in pixels of the finest picture, as its control starts; null: the window's",
        least=SIZES[0],
        most=SIZES[1],
    )
    seconds: float = setting(10.0, "seconds that a picture may take, as its control starts", above=0, most=MOST_SECONDS)
