"""The scenes that ship inside the package, lit and dark: something real to train on without a download."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.data.config import FolderConfig, PhotoConfig
from ctm_plugin.data.llff import LLFFConfig
from ctm_plugin.scene.views import Scene
from ctm_plugin.settings.build import setting
from ctm_plugin.settings.check import Number, check_choice

LIGHTS = ("dark", "lit")
ASSETS = Path(__file__).parent / "assets"


@dataclass(frozen=True, kw_only=True)
class EmbeddedConfig(PhotoConfig):
    """How to read a scene of the package, a folder of ``ASSETS`` for each light in one of the layouts."""

    scene: ClassVar[str]
    layout: ClassVar[type[FolderConfig]]
    light: str = setting("dark", "dark: rendered under weak light; lit: the same cameras under normal light")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("dataset.light", self.light, LIGHTS)

    def load(self) -> Scene:
        """Read the scene, see its layout's ``load``; it is named with its light, ``still_life_dark``.

        Its exposure is the light that it was rendered under times ``exposure``.

        Raises:
            DataError: the installed package is damaged.
            ConfigError: ``downscale`` or ``width`` do not suit 128 pixels, or ``background`` is ``random_matched``
                without alpha.
        """
        given = {name: getattr(self, name) for name in PhotoConfig.__dataclass_fields__}
        scene = self.layout(root=ASSETS / self.scene / self.light, **given).load()
        return replace(scene, name=f"{self.scene}_{self.light}")


@dataclass(frozen=True, kw_only=True)
class StillLifeConfig(EmbeddedConfig):
    """The still life that comes with the package: 100 + 25 views of 128x128 pixels with alpha, with depth."""

    scene, layout = "still_life", BlenderConfig
    background: str = "random_matched"
    background_level: Number | str | None = "scene"
    geometry: str = "bounded"


@dataclass(frozen=True, kw_only=True)
class WhiteRoomConfig(EmbeddedConfig):
    """The white room that comes with the package: 42 + 7 views of 128x128 pixels, forward-facing, with depth."""

    scene, layout = "white_room", LLFFConfig
    background: str = setting("random", "what rays that hit nothing show: black, white or random")
    geometry: str = "forward"
