"""The settings of all appearances; torch is not needed to check them."""

from __future__ import annotations

from dataclasses import dataclass

from ctm_plugin.settings.setting import Settings, setting


@dataclass(frozen=True, kw_only=True)
class ExposureConfig(Settings, section="appearance"):
    """What exposures start from, and how fast they learn."""

    start: str = setting(
        "light",
        "exposures before the first step: same (one for all), light (each picture's mean light), exif (time x ISO "
        "/ f-number², from EXIF)",
        choices=("same", "light", "exif"),
    )
    fixed: bool = setting(False, "keep the exposures as they start")
    lr: float = setting(1e-2, "Adam's learning rate of the exposures' natural logarithms", above=0)
    lr_decay: float = setting(
        0.1, "factor that the appearance's learning rates fall to by the last step, exponentially", above=0, most=1
    )


@dataclass(frozen=True, kw_only=True)
class AffineConfig(ExposureConfig):
    """How far colours may be mixed."""

    lr_colors: float = setting(2e-3, "learning rate of the colour matrices", above=0)
    identity: float = setting(0.1, "weight of the matrices' mean squared distance from the identity", least=0)


@dataclass(frozen=True, kw_only=True)
class BilateralConfig(ExposureConfig):
    """How fine the grids are, and how smooth."""

    across: int = setting(16, "columns, and rows, of each picture's grid", least=2, most=256)
    levels: int = setting(8, "levels of brightness in each picture's grid", least=2, most=256)
    lr_grid: float = setting(2e-3, "learning rate of the grids", above=0)
    smooth: float = setting(
        10.0, "weight of the grids' total variation: more makes neighbouring maps more alike", least=0
    )
