"""The settings that all layouts of photographs share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ctm_plugin.data.degrade import LightConfig
from ctm_plugin.errors import ConfigError
from ctm_plugin.scene.poses import MAX_COORDINATE
from ctm_plugin.scene.views import BACKGROUNDS, GEOMETRIES, Views
from ctm_plugin.settings.build import REQUIRED, setting
from ctm_plugin.settings.check import Number, check_choice, check_integer, check_number


@dataclass(frozen=True, kw_only=True)
class PhotoConfig(LightConfig):
    """How photographs become training data."""

    downscale: int = setting(1, "whole factor by which both sides shrink, a divisor of both")
    skip: int = setting(1, "keep every skip-th training view, the first one included; test views all stay")
    background: str = setting("white", "what rays that hit nothing show: black, white, random_matched or random")
    background_level: Number | str | None = setting(
        None, "of random ones: colours up to a number or to `scene`'s 99th percentile; null: in CTM's latent space"
    )
    geometry: str = setting("bounded", "bounded (cameras around an object), forward (for NDC) or unbounded")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_integer("dataset.downscale", self.downscale, 1)
        check_integer("dataset.skip", self.skip, 1)
        check_choice("dataset.background", self.background, BACKGROUNDS)
        if self.background_level not in (None, "scene"):
            expected = "a number in (0, 1], scene or null"
            check_number("dataset.background_level", self.background_level, lambda v: 0 < v <= 1, expected)
        check_choice("dataset.geometry", self.geometry, GEOMETRIES)


@dataclass(frozen=True, kw_only=True)
class FolderConfig(PhotoConfig):
    """Photographs in a folder."""

    root: str | Path = setting(REQUIRED, "the data set's folder")
    links: bool = setting(True, "whether the folder may hold links to what lies outside it")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.links, bool):
            raise ConfigError("dataset.links", self.links, "true or false")
        if not isinstance(self.root, (str, Path)) or not str(self.root).strip():
            raise ConfigError("dataset.root", self.root, "the folder of a data set")


@dataclass(frozen=True, kw_only=True)
class BoundsConfig(FolderConfig):
    """Photographs with bounds that can be given."""

    near: Number | None = setting(None, "bounds along the rays, in units of the files' poses; null: what the files say")
    far: Number | None = setting(None, "as near")

    def __post_init__(self) -> None:
        super().__post_init__()
        for key in ("near", "far"):
            if (value := getattr(self, key)) is not None:
                check_number(f"dataset.{key}", value, is_bound, "a distance >= 0 in scene units, or null")
        if self.near is not None and self.far is not None and self.near >= self.far:
            raise ConfigError("dataset.far", self.far, f"more than dataset.near, {self.near}")


@dataclass(frozen=True, kw_only=True)
class CaptureConfig(FolderConfig):
    """Photographs of one capture, of which some are kept for testing."""

    test_every: int = setting(8, "each view with a number, by name from 0, divisible by this is for testing")
    background: str = "black"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_integer("dataset.test_every", self.test_every, 2)


def is_bound(value: Number) -> bool:
    """Whether a distance can be near or far."""
    return 0 <= value <= MAX_COORDINATE


def check_matched_background(config: PhotoConfig, views: Views, root: Path) -> None:
    """Refuse ``random_matched`` for pictures without alpha: nobody knows where another background would show.

    Raises:
        ConfigError: the views have no alpha.
    """
    if config.background == "random_matched" and not views.has_alpha:
        expected = f"black, white or random: the images of {root} have no alpha to composite with"
        raise ConfigError("dataset.background", config.background, expected)
