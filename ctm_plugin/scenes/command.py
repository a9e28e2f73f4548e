"""Scenes as data sets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ctm_plugin.errors import ConfigError
from ctm_plugin.scenes.plan import check_scene
from ctm_plugin.scenes.presets import PRESETS
from ctm_plugin.scenes.render import render
from ctm_plugin.scenes.render_settings import RenderSettings
from ctm_plugin.settings.build import REQUIRED, build, pairs, setting


@dataclass(frozen=True, kw_only=True)
class Folders:
    """Where from and where to."""

    out: str = setting(REQUIRED, "folder to render into; it is made if missing")
    source: str | None = setting(None, "folder with the preset's .blend files")


def scenes(scene: Path, settings: Folders, others: Sequence[str]) -> None:
    """Render a scene into a folder that trainings read; a stopped rendering goes on where it was.

    SCENE is one of these, or the path of a ``.blend``:

    still_life (vase, books, fruit and brass on a turned stand), workshop (a model railway), white_room (blank walls and
    window light, forward-facing), stairwell (balusters between plain walls at dusk, forward-facing).

    With ``source=DIR`` it may be a data set of the paper: synthetic_nerf_dark (Synthetic-NeRF's 8 scenes in weak light,
    from its own cameras), low_texture_blender (7 rooms and objects with blank surfaces, 49 forward-facing views).

    Raises:
        CTMError: there is no such scene, Blender's module is missing, or what :func:`render` says.
    """
    name, out, given = str(scene), Path(settings.out).expanduser(), pairs(others)
    try:
        if name not in PRESETS:
            check_scene(name, PRESETS)
            render(name, out, build(RenderSettings, given, "scenes"))
            return
        if settings.source is None:
            raise ConfigError("source", None, "a folder, as source=DIR")
        for each, target, how in PRESETS[name].renderings(Path(settings.source).expanduser(), out, given):
            render(each, target, how)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("stopped; the same command goes on from here") from None
