"""The scenes that ship inside the package, lit and dark: something real to train on without a download."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import ClassVar

from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.data.llff import LLFFConfig
from ctm_plugin.data.settings import EmbeddedSettings, FolderConfig, PhotoConfig, StillLifeSettings, WhiteRoomSettings
from ctm_plugin.scene.views import Scene

ASSETS = Path(__file__).parent / "assets"
"""Folder of the scenes that come with the package."""


class Embedded(EmbeddedSettings):
    """A scene of the package: a folder of ``ASSETS`` for each light, in one of the layouts."""

    scene: ClassVar[str]
    layout: ClassVar[type[FolderConfig]]

    def load(self) -> Scene:
        """Read the embedded scene by its layout's ``load``; its name has its light, ``still_life_dark``.

        The scene's exposure is the light that it was rendered under times ``exposure``.

        Raises:
            DataError: the installed package is damaged.
            ConfigError: ``downscale`` or ``width`` do not suit 128 pixels.
        """
        given = {each.name: getattr(self, each.name) for each in fields(PhotoConfig)}
        scene = self.layout(root=ASSETS / self.scene / self.light, **given).load()
        return replace(scene, name=f"{self.scene}_{self.light}")


class StillLifeConfig(Embedded, StillLifeSettings):
    scene, layout = "still_life", BlenderConfig


class WhiteRoomConfig(Embedded, WhiteRoomSettings):
    scene, layout = "white_room", LLFFConfig
