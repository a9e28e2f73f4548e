"""Scenes as data sets: the verb, and the paper's two sets, rendered anew from public ``.blend`` files (Appendix A)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ctm_plugin.errors import ConfigError, DataError, UnknownNameError
from ctm_plugin.settings.build import build, pairs
from ctm_scenes.plan import is_folder, read_trajectory
from ctm_scenes.render import render
from ctm_scenes.settings import Folders, RenderSettings
from ctm_scenes.spec import SCENES


@dataclass(frozen=True)
class Preset:
    """A data set of the paper: names of scenes, and settings, in which ``{cameras}`` is the scene's own folder."""

    scenes: tuple[str, ...]
    settings: Mapping[str, object]

    def renderings(
        self, source: Path, out: Path, given: Mapping[str, object]
    ) -> list[tuple[str, Path, RenderSettings]]:
        """Tell what is to be rendered; ``given`` goes before the preset's own settings.

        Raises:
            DataError: files are missing from the source folder, or cameras to be followed cannot be used.
        """
        if missing := [f"{scene}.blend" for scene in self.scenes if not (source / f"{scene}.blend").is_file()]:
            raise DataError(source, f"no {', '.join(missing)}", "the .blend files named in docs/scenes.md")
        found = []
        for scene in self.scenes:
            own = {**self.settings, "trajectory": str(self.settings["trajectory"]).format(cameras=source / scene)}
            chosen = build(RenderSettings, {**own, **given}, "scenes")
            if is_folder(chosen.trajectory):
                read_trajectory(Path(chosen.trajectory).expanduser())
            found.append((str(source / f"{scene}.blend"), out / scene, chosen))
        return found


PRESETS = {
    # How weak the paper's light is, it does not say.
    "synthetic_nerf_dark": Preset(
        ("chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship"),
        {"light": 0.02, "width": 800, "samples": 256, "trajectory": "{cameras}"},
    ),
    # Nor the size of these pictures; LLFF's at a quarter.
    "low_texture_blender": Preset(
        ("bathroom", "bathroom_2", "bathroom_3", "dark_kitchen", "island_kitchen", "low_poly_deer", "staircase"),
        {"width": 1008, "height": 756, "samples": 512, "trajectory": "forward", "views": 49},
    ),
}


def scenes(scene: Path, settings: Folders, others: Sequence[str]) -> None:
    """Render a scene into a folder that trainings read; a stopped rendering goes on where it was.

    SCENE is the path of a ``.blend``, or the name of a scene of an installed package. This one has

    still_life (vase, books, fruit and brass on a turned stand), workshop (a model railway), white_room (blank walls and
    window light, forward-facing), stairwell (balusters between plain walls at dusk, forward-facing).

    With ``source=DIR`` it may be a data set of the paper: synthetic_nerf_dark (Synthetic-NeRF's 8 scenes in weak light,
    from its own cameras), low_texture_blender (7 rooms and objects with blank surfaces, 49 forward-facing views).

    Raises:
        CTMError: there is no such scene, Blender's module is missing, or what :func:`render` says.
    """
    name, out, given = str(scene), Path(settings.out).expanduser(), pairs(others)
    if name not in PRESETS:
        if not name.endswith(".blend") and name not in SCENES.names():
            raise UnknownNameError("scene", name, {*SCENES.names(), *PRESETS, "a path to a .blend file"})
        work = [(name, out, build(RenderSettings, given, "scenes"))]
    elif settings.source is None:
        raise ConfigError("source", None, "a folder, as source=DIR")
    else:
        work = PRESETS[name].renderings(Path(settings.source).expanduser(), out, given)
    try:
        for each, target, how in work:
            render(each, target, how)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("stopped; the same command goes on from here") from None
