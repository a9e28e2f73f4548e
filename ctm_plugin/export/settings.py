"""Settings of exports and films; torch is not needed to check them."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from ctm_plugin.errors import ConfigError
from ctm_plugin.runs.settings import LitConfig
from ctm_plugin.settings.setting import setting

CAMERA_PATHS = ("capture", "orbit", "spiral", "test")
"""Names of camera paths."""
EXPORTS = ("splats", "points", "mesh", "cameras", "pictures", "page")
"""Names of the kinds of exports of a run."""


@dataclass(frozen=True, kw_only=True)
class ExportConfig(LitConfig):
    """Kind and resolution of an export."""

    what: str | None = setting(
        None,
        "splats, points or mesh (.ply), cameras (with photographs), pictures (lit) or "
        "page; null: splats where there are some, else points",
        choices=EXPORTS,
    )
    out: str | None = setting(None, "folder to write to; null: RUN_DIR/export, of what=page RUN_DIR")
    points: int = setting(200_000, "largest number of points", least=1)
    cells: int = setting(128, "cells of the mesh along its longest side", least=2, most=2048)
    opaque: float = setting(
        0.5,
        "share of light that a point's ray stops, or that a hundredth of the mesh's side stops at its surface",
        above=0,
        below=1,
    )
    photographs: bool = setting(False, "of what=pictures: the photographs, lit, in place of renderings")
    overwrite: bool = setting(False, "replace existing files")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.photographs and self.what != "pictures":
            raise self.fault("photographs", "false, or what=pictures")


@dataclass(frozen=True, kw_only=True)
class VideoConfig(LitConfig):
    """Path and pictures of a film."""

    light: str | None = setting(
        None,
        "brightening: auto, a number of stops, or off, see ctm evaluate --help; null: as a viewer's .json says, else "
        "auto",
    )
    path: str | None = setting(
        None,
        "capture (past the photographs' places), orbit, spiral, test (test cameras) or a viewer's .json; null: "
        "orbit where cameras surround the scene, else capture",
    )
    what: str = setting(
        "lit", "lit (lit pictures), or all (lit, dark, depth and latent side by side)", choices=("lit", "all")
    )
    frames: int = setting(120, "number of frames, of all paths but test", least=1)
    fps: int = setting(24, "frames a second", least=1)
    out: str | None = setting(
        None, "file to write, .mp4, .webp or .gif; null: RUN_DIR/video/PATH.mp4, or .gif without the extra video"
    )
    overwrite: bool = setting(False, "replace existing videos")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.path is not None and not self.path.endswith(".json") and self.path not in CAMERA_PATHS:
            raise self.fault("path", f"one of {', '.join(CAMERA_PATHS)}, FILE.json")
        if self.out is not None and (suffix := Path(self.out).suffix) not in (".gif", ".mp4", ".webp"):
            raise ConfigError("out", suffix, "one of .gif, .mp4, .webp")
        if self.out is not None and suffix == ".mp4" and not can_mp4():
            raise self.fault("out", "a .gif, or pip install -e '.[video]'")


def can_mp4() -> bool:
    return find_spec("imageio_ffmpeg") is not None
