"""The scenes that ship inside the package, lit and dark: something real to train on without a download."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from ctm_plugin.data.blender import BlenderConfig, load_blender
from ctm_plugin.data.config import PhotoConfig
from ctm_plugin.data.llff import LLFFConfig, load_llff
from ctm_plugin.scene.views import Scene
from ctm_plugin.settings.build import setting
from ctm_plugin.settings.check import Number, check_choice

LIGHTS = ("dark", "lit")
ASSETS = Path(__file__).parent / "assets"
STILL_LIFE, WHITE_ROOM = ASSETS / "still_life", ASSETS / "white_room"


@dataclass(frozen=True, kw_only=True)
class EmbeddedConfig(PhotoConfig):
    """How to read a scene of the package."""

    light: str = setting("dark", "dark, rendered under weak light, or lit, the same cameras under normal light")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("dataset.light", self.light, LIGHTS)

    def photo(self) -> dict[str, object]:
        """The settings that all layouts share."""
        return {name: getattr(self, name) for name in PhotoConfig.__dataclass_fields__}


@dataclass(frozen=True, kw_only=True)
class StillLifeConfig(EmbeddedConfig):
    """The still life that comes with the package: 100 + 25 views of 128x128 pixels with alpha, with depth."""

    background: str = "random_matched"
    background_level: Number | str | None = "scene"

    def load(self) -> Scene:
        """See :func:`load_still_life`."""
        return load_still_life(self)


@dataclass(frozen=True, kw_only=True)
class WhiteRoomConfig(EmbeddedConfig):
    """The white room that comes with the package: 42 + 7 views of 128x128 pixels, forward-facing, with depth."""

    background: str = setting("random", "what rays that hit nothing show: black, white or random")
    geometry: str = "forward"

    def load(self) -> Scene:
        """See :func:`load_white_room`."""
        return load_white_room(self)


def load_still_life(config: StillLifeConfig) -> Scene:
    """Read the still life, see :func:`~ctm_plugin.data.blender.load_blender`.

    Returns:
        The scene ``still_life_dark`` or ``still_life_lit``. Its exposure is the light it was rendered under times
        ``config.exposure``.

    Raises:
        DataError: the installed package is damaged.
        ConfigError: ``downscale`` or ``width`` do not suit 128 pixels.
    """
    scene = load_blender(BlenderConfig(root=STILL_LIFE / config.light, **config.photo()))
    return replace(scene, name=f"still_life_{config.light}")


def load_white_room(config: WhiteRoomConfig) -> Scene:
    """Read the white room, see :func:`~ctm_plugin.data.llff.load_llff`; every eighth view is for testing.

    Returns:
        The scene ``white_room_dark`` or ``white_room_lit``. Its exposure is the light it was rendered under times
        ``config.exposure``.

    Raises:
        DataError: the installed package is damaged.
        ConfigError: ``downscale`` or ``width`` do not suit 128 pixels, or ``background`` is ``random_matched``, which
            needs alpha.
    """
    scene = load_llff(LLFFConfig(root=WHITE_ROOM / config.light, **config.photo()))
    return replace(scene, name=f"white_room_{config.light}")
