"""The settings that all layouts of photographs share."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from ctm_plugin.check import Number, check_choice, check_integer, check_number
from ctm_plugin.data.degrade import NoiseConfig
from ctm_plugin.data.poses import MAX_COORDINATE
from ctm_plugin.data.scene import BACKGROUNDS, GEOMETRIES, Views
from ctm_plugin.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class PhotoConfig:
    """How photographs become training data.

    Attributes:
        downscale: whole factor by which both sides shrink, a divisor of both; box average, alpha premultiplied.
        skip: keep every ``skip``-th training view, the first one included; test views all stay.
        background: what rays that hit nothing show: ``black``, ``white``, ``random_matched`` or ``random``.
        background_level: random backgrounds are colours uniform in [0, level]^3; ``scene``: up to the scene's own
            brightness (99th percentile); ``None``: uniform in the colour transform's own space, as in the paper.
        exposure: factor on the light, in (0, 1]; 1 is as photographed.
        noise: of the sensor, on training views only, so that metrics measure the scene and not the noise.
        geometry: ``bounded`` (cameras around an object), ``forward`` (all look the same way; the world is moved for
            NDC, see :func:`ctm_plugin.data.geometry.settle`) or ``unbounded``.

    Raises:
        ConfigError: a value is out of range.
    """

    downscale: int = 1
    skip: int = 1
    background: str = "white"
    background_level: Number | str | None = None
    exposure: Number = 1.0
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    geometry: str = "bounded"

    def __post_init__(self) -> None:
        check_integer("dataset.downscale", self.downscale, 1)
        check_integer("dataset.skip", self.skip, 1)
        check_choice("dataset.background", self.background, BACKGROUNDS)
        if self.background_level not in (None, "scene"):
            expected = "a number in (0, 1], scene or null"
            check_number("dataset.background_level", self.background_level, lambda v: 0 < v <= 1, expected)
        check_number("dataset.exposure", self.exposure, lambda v: 0 < v <= 1, "a number in (0, 1]")
        if not isinstance(self.noise, NoiseConfig):
            raise ConfigError("dataset.noise", self.noise, "read, shot and seed")
        check_choice("dataset.geometry", self.geometry, GEOMETRIES)


@dataclass(frozen=True, kw_only=True)
class BoundsConfig(PhotoConfig):
    """Photographs in a folder, with bounds that can be given.

    Attributes:
        root: the data set's folder.
        near, far: bounds along the rays, in units of the files' poses; ``None`` takes what the files say.

    Raises:
        ConfigError: a value is out of range.
    """

    root: str | Path
    near: Number | None = None
    far: Number | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_root(self.root)
        for key in ("near", "far"):
            if (value := getattr(self, key)) is not None:
                check_number(f"dataset.{key}", value, is_bound, "a distance >= 0 in scene units, or null")
        if self.near is not None and self.far is not None and self.near >= self.far:
            raise ConfigError("dataset.far", self.far, f"more than dataset.near, {self.near}")


@dataclass(frozen=True, kw_only=True)
class CaptureConfig(BoundsConfig):
    """Photographs of one capture, of which some are kept for testing.

    Attributes:
        test_every: every ``test_every``-th view by name, the first one included, is for testing.

    Raises:
        ConfigError: a value is out of range.
    """

    test_every: int = 8
    background: str = "black"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_integer("dataset.test_every", self.test_every, 2)


def is_bound(value: Number) -> bool:
    """Whether a distance can be near or far."""
    return 0 <= value <= MAX_COORDINATE


def check_root(root: object) -> None:
    """Refuse what cannot name a folder.

    Raises:
        ConfigError: ``root`` is not a path or empty.
    """
    if not isinstance(root, (str, Path)) or not str(root).strip():
        raise ConfigError("dataset.root", root, "the folder of a data set")


def check_matched_background(config: PhotoConfig, views: Views, root: Path) -> None:
    """Refuse ``random_matched`` for pictures without alpha: nobody knows where another background would show.

    Raises:
        ConfigError: the views have no alpha.
    """
    if config.background == "random_matched" and not views.has_alpha:
        expected = f"black, white or random: the images of {root} have no alpha to composite with"
        raise ConfigError("dataset.background", config.background, expected)
