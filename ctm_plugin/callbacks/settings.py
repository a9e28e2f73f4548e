"""The settings of all callbacks; torch is not needed to check them."""

from __future__ import annotations

from dataclasses import dataclass

from ctm_plugin.settings.setting import Settings, setting


@dataclass(eq=False)
class FilmConfig(Settings, section="callbacks.film"):
    """Pictures of the training, now and then, and a film of them at the end."""

    frames: int = setting(20, "approximate number of pictures", least=1)
