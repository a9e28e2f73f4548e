"""Settings of workflows; torch is not needed to check them."""

from __future__ import annotations

from dataclasses import dataclass

from ctm_plugin.settings.setting import Settings, setting


@dataclass(frozen=True, kw_only=True)
class PhotosConfig(Settings):
    """Settings of ``ctm photos``: the time that it may take."""

    minutes: float = setting(
        10.0,
        "minutes of training on this machine, approximately; the pictures' size and the budget follow from it",
        above=0,
    )
    again: bool = setting(False, "train again, in a new folder, although there is a finished run of this folder")
