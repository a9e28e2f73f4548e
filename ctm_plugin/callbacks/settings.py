"""The settings of all callbacks; torch is not needed to check them."""

from __future__ import annotations

from dataclasses import dataclass

from ctm_plugin.settings.setting import Settings, setting


@dataclass(eq=False)
class ProgressConfig(Settings, section="callbacks.progress"):
    """Steps, loss, PSNR of the batch in RGB, rays a second and ETA; a line now and then where there is no terminal."""

    refresh_seconds: float | None = setting(
        None, "seconds between updates; null: 0.5 on a terminal, 20 elsewhere", above=0
    )


@dataclass(eq=False)
class DashboardConfig(Settings, section="callbacks.dashboard"):
    """Curves every ``trainer.log_every`` steps; pictures before the first step, now and then, and at the end."""

    image_every: int | None = setting(
        None, "steps between pictures; null: no pictures", composed="${trainer.image_every}", least=1
    )


@dataclass(eq=False)
class FilmConfig(Settings, section="callbacks.film"):
    """Pictures of the training, now and then, and a film of them at the end."""

    frames: int = setting(20, "approximate number of pictures", least=1)
