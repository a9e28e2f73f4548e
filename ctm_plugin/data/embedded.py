"""The still life that ships inside the package, lit and dark: something real to train on without a download."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from ctm_plugin.data.blender import BlenderConfig, load_blender
from ctm_plugin.data.check import check_choice
from ctm_plugin.data.config import PhotoConfig
from ctm_plugin.data.scene import Scene

LIGHTS = ("dark", "lit")
STILL_LIFE = Path(__file__).parents[1] / "scenes" / "assets" / "still_life"


@dataclass(frozen=True, kw_only=True)
class StillLifeConfig(PhotoConfig):
    """How to read the still life: 100 training and 25 test views of 128x128 pixels with alpha; test views have depth.

    Attributes:
        light: ``dark``, rendered under weak light, or ``lit``, the same cameras under normal light.

    The others are :class:`~ctm_plugin.data.config.PhotoConfig`'s; ``exposure`` dims further.

    Raises:
        ConfigError: a value is out of range.
    """

    light: str = "dark"
    background: str = "random_matched"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("dataset.light", self.light, LIGHTS)

    def load(self) -> Scene:
        """See :func:`load_still_life`."""
        return load_still_life(self)


def load_still_life(config: StillLifeConfig) -> Scene:
    """Read the still life, see :func:`~ctm_plugin.data.blender.load_blender`.

    Returns:
        The scene ``still_life_dark`` or ``still_life_lit``. Its exposure is the light it was rendered under times
        ``config.exposure``.

    Raises:
        DataError: the installed package is damaged.
        ConfigError: ``downscale`` does not divide 128.
    """
    photo = {name: getattr(config, name) for name in PhotoConfig.__dataclass_fields__}
    return replace(
        load_blender(BlenderConfig(root=STILL_LIFE / config.light, **photo)), name=f"still_life_{config.light}"
    )
