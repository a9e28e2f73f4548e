"""What can be set of the viewer."""

from __future__ import annotations

from dataclasses import dataclass

from ctm_plugin.color.light import factor_of
from ctm_plugin.runs.data import RunConfig
from ctm_plugin.settings.build import setting
from ctm_plugin.settings.check import check_integer, check_number

SIZES = (64, 4096)
"""Least and most pixels along a finest picture's longer side."""
MOST_SECONDS = 600


@dataclass(frozen=True, kw_only=True)
class ViewConfig(RunConfig):
    """Where to listen, and how to look."""

    port: int = setting(8080, "port of the page")
    host: str = setting(
        "127.0.0.1",
        "address to listen at; other addresses than 127.0.0.1, such as 0.0.0.0, let anyone look who has the "
        "printed address with its token",
    )
    light: str = setting(
        "auto",
        "brightening that the slider starts with: auto (dark scenes get a normal mean), a number of stops, or off",
    )
    size: int | None = setting(
        None, "longer side in pixels of the finest picture, as its control starts; null: the window's"
    )
    seconds: float = setting(10.0, "seconds that a picture may take, as its control starts")

    def __post_init__(self) -> None:
        factor_of(self.light, 1.0)
        if self.size is not None:
            check_integer("size", self.size, *SIZES)
        check_number("seconds", self.seconds, lambda seconds: 0 < seconds <= MOST_SECONDS, f"in (0, {MOST_SECONDS}]")
        check_integer("port", self.port, 1)
