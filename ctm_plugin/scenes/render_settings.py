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

    light: float = setting(1.0, "factor on every lamp, the world and emitting materials, > 0; 1: normal light")
    width: int = setting(128, "width in pixels, 16 to 8192")
    height: int = setting(0, "height in pixels; 0: the width")
    samples: int = setting(32, "light paths a pixel, >= 1")
    denoise: bool = setting(True, "clean the pictures with OpenImageDenoise")
    seed: int = setting(0, "seed of the sampling and of the cameras' jitter, >= 0")
    views: int = setting(0, "number of training views; 0: the scene's own number")
    test_views: int = setting(
        0,
        "number of test views; 0: the scene's own; 0 on forward-facing scenes, where some of the views are for testing",
    )
    trajectory: str = setting(
        "own",
        "own (a .blend's is forward), hemisphere (around the origin), forward (a grid at the file's camera), or a "
        "folder with transforms_train.json and transforms_test.json",
    )
    extent: float = setting(
        0.2, "side of the grid of trajectory=forward, divided by the distance to what the file's camera sees"
    )
    background: str = setting("own", "own, transparent or opaque: whether the world is visible behind the scene")
    depth: str = setting(
        "float", "float: float32 arrays; code: 16-bit pictures in steps of 1/4096, a tenth of the size"
    )
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
        check_choice("background", self.background, ("own", "transparent", "opaque"))
        check_choice("depth", self.depth, ("float", "code"))
        check_choice("device", self.device, ("auto", "cpu", "gpu"))

    @property
    def size(self) -> tuple[int, int]:
        """Give width and height in pixels."""
        return self.width, self.height or self.width
