"""The settings of appearances; torch is not needed to check them."""

from __future__ import annotations

from dataclasses import dataclass

from ctm_plugin.settings.setting import Settings, setting


@dataclass(frozen=True, kw_only=True)
class ExposureConfig(Settings, section="appearance"):
    """What exposures start from, and how fast they learn."""

    start: str = setting(
        "light",
        "exposures before the first step: same, light (of points that several pictures see, else each picture's mean), "
        "exif (time x ISO / f-number², from EXIF)",
        choices=("same", "light", "exif"),
    )
    fixed: bool = setting(False, "keep the exposures as they start")
    lr: float = setting(1e-2, "Adam's learning rate of the exposures' natural logarithms", above=0)
    lr_decay: float = setting(
        0.1, "factor that the appearance's learning rates fall to by the last step, exponentially", above=0, most=1
    )
