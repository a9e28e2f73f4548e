"""The settings of all data sets; no picture is read, and torch is not needed, to check them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int64

from ctm_plugin.errors import ConfigError
from ctm_plugin.scene.kinds import AUTO, BACKGROUNDS, GEOMETRIES
from ctm_plugin.scene.poses import MAX_COORDINATE
from ctm_plugin.settings.setting import REQUIRED, Number, Settings, setting

PHOTOGRAPHS = {
    "astronaut": "astronaut.png", "chelsea": "chelsea.png", "coffee": "coffee.png", "rocket": "rocket.jpg",
}  # fmt: skip
"""File names of scikit-image's colour photographs by their names."""
RAWNERF_SCENES = (
    "bikes", "candlefiat", "livingroom", "morningkitchen", "nightstreet", "notchbush", "parkstatue", "scooter",
    "streetcorner",
)  # fmt: skip
"""RawNeRF's scenes that the paper uses."""
FULL = "full"
"""Width of pictures that are not shrunk."""


@dataclass(frozen=True, kw_only=True)
class NoiseConfig(Settings, section="dataset.noise"):
    """Noise of a sensor, in linear light where 1 is full scale: ``variance = shot x light + read²``."""

    read: Number = setting(
        0.0, "standard deviation of the noise that does not depend on the light, in linear light", least=0, most=1
    )
    shot: Number = setting(0.0, "variance of the photons' noise per unit of linear light", least=0, most=1)
    seed: int = setting(0, "seed of the noise's random numbers", least=0)

    @property
    def off(self) -> bool:
        return self.read == 0 and self.shot == 0


@dataclass(frozen=True, kw_only=True)
class DimConfig(Settings, section="dataset"):
    """Settings that make dark pictures of lit ones."""

    exposure: Number = setting(1.0, "factor on the linear light of the pictures; 1: as photographed", above=0, most=1)
    noise: NoiseConfig = setting(NoiseConfig(), "noise of a sensor, added to training views (or patches)")


@dataclass(frozen=True, kw_only=True)
class PhotoConfig(DimConfig):
    """Settings that make training data of photographs."""

    downscale: Number = setting(
        1, "number, whole or not, that both sides of the pictures are divided by", least=1, most=1e6
    )
    width: int | str | None = setting(
        None,
        "width that the pictures are shrunk to, instead of downscale; the height follows; full, or null: their own",
        least=1,
        choices=(FULL,),
    )
    skip: int = setting(1, "train on every skip-th training view, from the first; all test views stay", least=1)
    background: str = setting(
        "white", "what rays that hit nothing show: black, white, random_matched or random", choices=BACKGROUNDS
    )
    background_level: Number | str | None = setting(
        None,
        "largest colour of random backgrounds: a number, or scene (the 99th percentile of its colours); null: "
        "random latents instead",
        above=0,
        most=1,
        choices=("scene",),
    )
    geometry: str = setting(
        AUTO,
        "how the cameras stand: bounded (around a thing), forward (they look one way; NDC), unbounded, or auto "
        "(found from the cameras)",
        choices=(AUTO, *GEOMETRIES),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.width is not None and self.downscale != type(self).__dataclass_fields__["downscale"].default:
            raise self.fault("width", f"null with dataset.downscale={self.downscale}")
        if self.width == FULL:
            object.__setattr__(self, "width", None)

    @property
    def whole_factor(self) -> int:
        """The factor of a folder ``images_<factor>`` that may hold the pictures already shrunk; 1: no such folder."""
        return int(self.downscale) if self.width is None and self.downscale == int(self.downscale) else 1

    def trained_on(self, testing: Bool[np.ndarray, " n"]) -> Int64[np.ndarray, " t"]:
        """Indices of the pictures that become training views, in order: not for ``testing``, thinned by ``skip``."""
        return np.flatnonzero(~testing)[:: self.skip]

    def shrunk(self, height: int, width: int) -> tuple[int, int]:
        """Height and width to which pictures of this size shrink.

        Raises:
            ConfigError: nothing would be left of a side, or they would have to grow.
        """
        if self.width is None:
            size = round(height / self.downscale), round(width / self.downscale)
            if min(size) < 1:
                raise self.fault("downscale", f"at most a side of the pictures, {width}x{height}")
            return size
        if self.width > width:
            raise self.fault("width", f"at most that of the pictures, {width}x{height}")
        return max(1, round(height * self.width / width)), self.width


@dataclass(frozen=True, kw_only=True)
class FolderConfig(PhotoConfig):
    """Photographs in a folder.

    PNG, JPEG, WebP, TIFF and EXR are read. Floats are linear light. Pictures of 8 bits are
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

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.root, (str, Path)) or not str(self.root).strip():
            raise self.fault("root", "the folder of a data set")


@dataclass(frozen=True, kw_only=True)
class BoundsConfig(FolderConfig):
    """Photographs with bounds that can be given."""

    near: Number | None = setting(
        None,
        "distance at which rays begin, in units of the file's poses; null: the file's, else from points and cameras",
        least=0,
        most=MAX_COORDINATE,
    )
    far: Number | None = setting(
        None, "distance at which rays end; null: found as near is", least=0, most=MAX_COORDINATE
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.near is not None and self.far is not None and self.near >= self.far:
            raise self.fault("far", f"more than dataset.near, {self.near}")


@dataclass(frozen=True, kw_only=True)
class CaptureConfig(BoundsConfig):
    """Photographs of one capture, of which some are kept for testing."""

    test_every: int = setting(
        8,
        "every so many views, in order of their names and from the first, one is kept for testing, unless files list "
        "the test views",
        least=2,
    )
    background: str = "black"


@dataclass(frozen=True, kw_only=True)
class BlenderSettings(BoundsConfig):
    """Synthetic-NeRF's layout: transforms_train.json, transforms_test.json, RGBA pictures."""

    root: str | Path = setting(REQUIRED, "folder with transforms_train.json and transforms_test.json")


@dataclass(frozen=True, kw_only=True)
class ColmapSettings(CaptureConfig):
    """COLMAP's model, sparse/0 or sparse, binary or text, next to images, or images_<downscale> if there is one."""

    default_backbone = "splat"

    root: str | Path = setting(REQUIRED, "folder with sparse and images")
    images: str | None = setting(
        None, "folder of the pictures in root; null: images, or the only folder with pictures of the right names"
    )


@dataclass(frozen=True, kw_only=True)
class LLFFSettings(CaptureConfig):
    """LLFF's layout: poses_bounds.npy next to a folder images, or images_<downscale> if there is one."""

    root: str | Path = setting(REQUIRED, "folder with poses_bounds.npy and images")
    factor: int | None = setting(
        None,
        "read pictures of images_<factor>, or of images with 1, then shrink them by downscale; null: "
        "images_<downscale>, else images",
        least=1,
    )


@dataclass(frozen=True, kw_only=True)
class RawNeRFSettings(LLFFSettings):
    """RawNeRF's scenes: LLFF's layout, with images or raw pictures in raw, which are developed (extra raw).

    RawNeRF's own experiments shrink by 4; the random background is the paper's.
    """

    root: str | Path = setting(REQUIRED, "folder of the scene, or, where scene is given, folder of all scenes")
    scene: str | None = setting(
        None, f"scene in root, one of {', '.join(RAWNERF_SCENES)}; null: root is the scene", choices=RAWNERF_SCENES
    )
    downscale: Number = 4
    background: str = "random"
    geometry: str = "forward"


@dataclass(frozen=True, kw_only=True)
class TransformsSettings(CaptureConfig):
    """One transforms.json, or one for training and one for testing, with full intrinsics and lens distortion."""

    default_backbone = "splat"

    root: str | Path = setting(
        REQUIRED, "folder with transforms.json, or with transforms_train.json and transforms_test.json"
    )
    dark: str | None = setting(None, "folder in root with the dark pictures, where the files list lit ones")
    lit: str | None = setting(
        None, "folder in root with pictures of the test views in normal light, under the same names"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for key in ("dark", "lit"):
            if (name := getattr(self, key)) is not None and not name.strip():
                raise self.fault(key, "the name of a folder in dataset.root, or null")
        if self.lit is not None and self.lit == self.dark:
            raise self.fault("lit", "another folder than dataset.dark")


@dataclass(frozen=True, kw_only=True)
class EmbeddedSettings(PhotoConfig):
    """A scene of the package, rendered in two lights."""

    light: str = setting(
        "dark", "dark: rendered under weak light; lit: the same cameras under normal light", choices=("dark", "lit")
    )


@dataclass(frozen=True, kw_only=True)
class StillLifeSettings(EmbeddedSettings):
    """The still life that comes with the package: 100 + 25 views of 128x128 pixels with alpha, with depth."""

    background: str = "random_matched"
    background_level: Number | str | None = "scene"
    geometry: str = "bounded"


@dataclass(frozen=True, kw_only=True)
class WhiteRoomSettings(EmbeddedSettings):
    """The white room that comes with the package: 42 + 7 views of 128x128 pixels, forward-facing, with depth."""

    background: str = setting(
        "random", "what rays that hit nothing show: black, white or random", choices=("black", "white", "random")
    )
    geometry: str = "forward"


@dataclass(frozen=True, kw_only=True)
class PlanarSettings(DimConfig):
    """Five patches of one picture under unknown homographies (backbone=barf2d). The defaults are BARF's."""

    image: str | Path = setting("coffee", f"picture file, or one of scikit-image's {', '.join(PHOTOGRAPHS)}")
    height: int = setting(
        360, "height of the picture, which is scaled to cover height and width, then cropped", least=8
    )
    width: int = setting(480, "width of the picture, which is scaled to cover height and width, then cropped", least=8)
    patch: int = setting(180, "side of the square patches, in pixels", least=8)
    noise_h: Number = setting(
        0.1, "standard deviation of all eight parameters of the patches' homographies", least=0, most=2
    )
    noise_t: Number = setting(
        0.2, "distance that four patches are moved towards the corners, divided by half the longer side", least=0,
        most=2,
    )  # fmt: skip
    seed: int = setting(0, "seed of the homographies", composed="${seed}", least=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not str(self.image):
            raise ConfigError("dataset.image", str(self.image), f"a file, or one of {', '.join(PHOTOGRAPHS)}")
        for key in ("height", "width"):
            if getattr(self, key) < self.patch:
                raise self.fault(key, f"at least dataset.patch, {self.patch}")
