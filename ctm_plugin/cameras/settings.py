"""The settings of the search for cameras; torch is not needed to check them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ctm_plugin.settings.setting import Settings, setting

MIN_PICTURES = 3
"""Least number of pictures of a model, which the loaders require."""
DEFAULT_FOLDER = "images"
"""Name of the photographs' folder, by default."""
CAMERA_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
"""COLMAP's camera models that may be asked for."""


@dataclass(frozen=True, kw_only=True)
class CamerasConfig(Settings):
    """Settings of the search for cameras."""

    pictures: str = setting(
        DEFAULT_FOLDER,
        "folder in FOLDER with the photographs and no other pictures; images is looked for elsewhere if not there",
    )
    brighten: bool = setting(
        True, "search in copies that are as bright as a normal photograph; false: in the pictures as they are"
    )
    size: int = setting(
        800,
        "longest side in pixels of the pictures that are searched, shrunk by a whole number; 2000 where few are placed",
        least=64,
    )
    all_pairs: int = setting(
        40,
        "up to this many pictures, each is compared with all others; more with those that look alike and neighbours",
        least=MIN_PICTURES,
    )
    lens: str = setting(
        "SIMPLE_RADIAL",
        "COLMAP's model of the cameras: SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL or OPENCV",
        choices=CAMERA_MODELS,
    )
    overwrite: bool = setting(False, "replace cameras that are in the folder already")
    seed: int = setting(0, "seed of COLMAP's random numbers", least=0)
    threads: int = setting(-1, "processor threads; -1: all; with 1 the result is the same each time", least=-1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if Path(self.pictures).name != self.pictures:
            raise self.fault("pictures", "the name of a folder in FOLDER")
        if self.threads == 0:
            raise self.fault("threads", "a number >= 1, or -1 for all")
