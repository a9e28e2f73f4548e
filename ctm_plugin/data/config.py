"""The settings that all layouts of photographs share."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int64

from ctm_plugin.data.degrade import LightConfig
from ctm_plugin.data.rig import AUTO, Rig
from ctm_plugin.errors import ConfigError, CTMError
from ctm_plugin.scene.poses import MAX_COORDINATE
from ctm_plugin.scene.views import BACKGROUNDS, GEOMETRIES
from ctm_plugin.settings.build import REQUIRED, setting
from ctm_plugin.settings.check import Number, check_choice, check_integer, check_number

MAX_FACTOR = 1e6
"""Largest ``downscale``."""


@dataclass(frozen=True, kw_only=True)
class PhotoConfig(LightConfig):
    """How photographs become training data."""

    downscale: Number = setting(1, "number >= 1, whole or not, that both sides of the pictures are divided by")
    width: int | None = setting(None, "width that the pictures are shrunk to, instead of downscale; the height follows")
    skip: int = setting(1, "train on every skip-th training view, from the first; all test views stay")
    background: str = setting("white", "what rays that hit nothing show: black, white, random_matched or random")
    background_level: Number | str | None = setting(
        None,
        "largest colour of random backgrounds: a number, or scene (the 99th percentile of its colours); null: "
        "random latents instead",
    )
    geometry: str = setting(
        AUTO,
        "how the cameras stand: bounded (around a thing), forward (they look one way; NDC), unbounded, or auto "
        "(found from the cameras)",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_number("dataset.downscale", self.downscale, lambda v: 1 <= v <= MAX_FACTOR, "a number >= 1")
        if self.width is not None:
            check_integer("dataset.width", self.width, 1)
            if self.downscale != type(self).__dataclass_fields__["downscale"].default:
                raise ConfigError("dataset.width", self.width, f"null with dataset.downscale={self.downscale}")
        check_integer("dataset.skip", self.skip, 1)
        check_choice("dataset.background", self.background, BACKGROUNDS)
        if self.background_level not in (None, "scene"):
            expected = "a number in (0, 1], scene or null"
            check_number("dataset.background_level", self.background_level, lambda v: 0 < v <= 1, expected)
        check_choice("dataset.geometry", self.geometry, (AUTO, *GEOMETRIES))

    def rig(self) -> Rig | None:
        """Read how the cameras stand, without the pictures; ``None``: the layout does not tell."""
        return None

    @property
    def whole_factor(self) -> int:
        """The factor of a folder ``images_<factor>`` that may hold the pictures already shrunk; 1: none may."""
        return int(self.downscale) if self.width is None and self.downscale == int(self.downscale) else 1

    def trained_on(self, testing: Bool[np.ndarray, " n"]) -> Int64[np.ndarray, " t"]:
        """Numbers of the pictures that become training views, in order: not for ``testing``, thinned by ``skip``."""
        return np.flatnonzero(~testing)[:: self.skip]

    def shrunk(self, height: int, width: int) -> tuple[int, int]:
        """Height and width to which pictures of this size shrink.

        Raises:
            ConfigError: nothing would be left of a side, or they would have to grow.
        """
        if self.width is None:
            size = round(height / self.downscale), round(width / self.downscale)
            if min(size) < 1:
                raise ConfigError(
                    "dataset.downscale", self.downscale, f"at most a side of the pictures, {width}x{height}"
                )
            return size
        if self.width > width:
            raise ConfigError("dataset.width", self.width, f"at most that of the pictures, {width}x{height}")
        return max(1, round(height * self.width / width)), self.width


@dataclass(frozen=True, kw_only=True)
class FolderConfig(PhotoConfig):
    """Photographs in a folder.

    PNG, JPEG, WebP, TIFF and EXR are read. Floats are linear light; EXR needs the extra ``exr``. Pictures of 8 bits are
    kept in 8 bits. Where one has more, all are kept in float32, in four times the memory. Pixels of shrunk pictures are
    means over areas.

    A pixel counts in a mask that is shrunk where all of its area counts. Pictures of several sizes shrink by one
    factor; ``width`` is that of the widest.

    Near and far that come as depths become distances along the rays. ``forward`` moves the world so that the mean
    camera stands at the origin and looks along -z, and scales it so that near is 1. The others keep the files' units.

    Names inside files are relative to the folder, or absolute inside it, and may not lead out of it. A picture is also
    found with another ending, or under a name that other systems take for the same, such as ``a.JPG`` for ``a.jpg``.
    Hidden files are not read.
    """

    root: str | Path = setting(REQUIRED, "folder of the data set")
    links: bool = setting(True, "whether the folder may hold links to files outside it")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.root, (str, Path)) or not str(self.root).strip():
            raise ConfigError("dataset.root", self.root, "the folder of a data set")


@dataclass(frozen=True, kw_only=True)
class BoundsConfig(FolderConfig):
    """Photographs with bounds that can be given."""

    near: Number | None = setting(
        None,
        "distance at which rays begin, in units of the file's poses; null: the file's, else from points and cameras",
    )
    far: Number | None = setting(None, "distance at which rays end; null: found as near is")

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

    test_every: int = setting(
        8,
        "every so many views, in order of their names and from the first, one is kept for testing, unless files list "
        "the test views",
    )
    crop: tuple[int, ...] | None = setting(
        None,
        "[left, top] pixels that were cut off pictures smaller than their camera's size; []: they were scaled; "
        "null: unknown, which is refused",
    )
    background: str = "black"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_integer("dataset.test_every", self.test_every, 2)
        if self.crop is not None and (len(self.crop) not in (0, 2) or min(self.crop, default=0) < 0):
            raise ConfigError("dataset.crop", list(self.crop), "[], null or two integers >= 0, [left, top]")

    @property
    def whole_factor(self) -> int:
        """As others', but pixels that were cut off count in the pictures as they were taken."""
        return 1 if self.crop else super().whole_factor


def look(config: PhotoConfig) -> Rig | None:
    """Read how the cameras stand; ``None`` also where they cannot be read: that is reported when they are loaded."""
    with suppress(CTMError):
        return config.rig()
    return None


def is_bound(value: Number) -> bool:
    """Whether a distance can be near or far."""
    return 0 <= value <= MAX_COORDINATE
