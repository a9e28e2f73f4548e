"""What can be asked of a rendering."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ctm_plugin.settings.build import setting
from ctm_plugin.settings.check import check_choice, check_integer, check_number

LARGEST_SIZE = 8192


@dataclass(frozen=True, kw_only=True)
class RenderSettings:
    """How to render.

    Raises:
        ConfigError: a value is out of range.
    """

    light: float = setting(1.0, "factor on every lamp, the world and emitting materials, > 0; 1 is normal light")
    width: int = setting(128, "in pixels, 16 to 8192")
    height: int = setting(0, "the same; 0: as many as width")
    samples: int = setting(32, "light paths a pixel, >= 1")
    denoise: bool = setting(True, "clean the pictures with OpenImageDenoise")
    seed: int = setting(0, "of the sampling, the cameras' jitter and the noise, >= 0")
    views: int = setting(0, "pictures in the training split; 0: the scene's own number")
    test_views: int = setting(0, "the same of the test split; 0 on forward-facing scenes, which test on some of views")
    trajectory: str = setting(
        "own",
        "own: the scene's, or for a .blend forward; hemisphere around the origin at the distance of the file's "
        "camera; forward: a grid at the file's camera; or a folder whose transforms_train.json and "
        "transforms_test.json are followed view by view",
    )
    extent: float = setting(
        0.2, "edge of the grid of trajectory=forward, as a part of the distance to what its camera sees"
    )
    background: str = setting("own", "own, transparent or opaque: whether the world is seen behind the scene")
    noise_read: float = setting(0.0, "of a sensor, on training views, as dataset.noise.read")
    noise_shot: float = setting(0.0, "the same, in proportion to the light")
    depth: str = setting("float", "float: float32 arrays; code: 16-bit pictures in steps of 1/4096, ten times as small")
    device: str = setting("auto", "cpu, gpu, or auto: a GPU where there is one")

    def __post_init__(self) -> None:
        check_number("light", self.light, lambda v: 0 < v < math.inf, "a number > 0, 1 being normal light")
        check_number("width", self.width, lambda v: 16 <= v <= LARGEST_SIZE, "pixels, an integer from 16 to 8192")
        check_number(
            "height", self.height, lambda v: v == 0 or 16 <= v <= LARGEST_SIZE, "pixels, from 16 to 8192, or 0"
        )
        # Blender keeps the seed in a signed 32-bit integer.
        check_number("seed", self.seed, lambda v: 0 <= v < 2**31, "an integer from 0 to 2147483647")
        check_number("extent", self.extent, lambda v: 0 < v <= 2, "a number in (0, 2]")
        for key, least in {"samples": 1, "views": 0, "test_views": 0}.items():
            check_integer(key, getattr(self, key), least)
        for key in ("noise_read", "noise_shot"):
            check_number(key, getattr(self, key), lambda v: 0 <= v <= 1, "a number from 0 to 1")
        check_choice("background", self.background, ("own", "transparent", "opaque"))
        check_choice("depth", self.depth, ("float", "code"))
        check_choice("device", self.device, ("auto", "cpu", "gpu"))

    @property
    def size(self) -> tuple[int, int]:
        """Give width and height in pixels."""
        return self.width, self.height or self.width
