"""The paper's two data sets, rendered anew from the public ``.blend`` files (paper, Appendix A)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from ctm_plugin.errors import DataError
from ctm_plugin.scenes.plan import is_folder, read_trajectory
from ctm_plugin.scenes.render_settings import RenderSettings
from ctm_plugin.settings.build import build

SYNTHETIC_NERF = ("chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship")
"""Their ``.blend`` files come with NeRF's synthetic data set, in an archive that names each author and licence."""

LOW_TEXTURE = {
    "bathroom": ("bobal57", "CC-0", "blendswap.com/blend/21307"),
    "bathroom_2": ("nacimus", "CC-BY", "blendswap.com/blend/12584"),
    "bathroom_3": ("imperfectino", "CC-0", "blendswap.com/blend/29175"),
    "dark_kitchen": ("Vladoffsky", "CC-0", "blendswap.com/blend/19116"),
    "island_kitchen": ("Matteo Pascale", "royalty free", "blendswap.com/blend/26863"),
    "low_poly_deer": ("Spine69", "CC-0", "blendswap.com; the paper prints island_kitchen's address"),
    "staircase": ("blenderjunky", "CC-0", "blendswap.com/blend/11660"),
}
"""Author, licence and address of each ``.blend``."""


@dataclass(frozen=True)
class Preset:
    """A data set of several renderings.

    Attributes:
        scenes: their names; ``<scene>.blend`` has to lie in the source folder.
        settings: of one scene, given the source folder and the scene's name.
    """

    scenes: tuple[str, ...]
    settings: Callable[[Path, str], dict[str, object]]

    def renderings(
        self, source: Path, out: Path, given: Mapping[str, object]
    ) -> Iterator[tuple[str, Path, RenderSettings]]:
        """Yield scene, folder and settings of each rendering; ``given`` goes before the preset's own settings.

        Raises:
            DataError: files are missing from the source folder, or cameras to be followed cannot be used; raised before
                anything is rendered.
        """
        files = [source / f"{scene}.blend" for scene in self.scenes]
        if missing := [path.name for path in files if not path.is_file()]:
            raise DataError(source, f"no {', '.join(missing)}", "the .blend files named in docs/scenes.md")
        chosen = [build(RenderSettings, {**self.settings(source, scene), **given}, "scenes") for scene in self.scenes]
        for settings in chosen:
            if is_folder(settings.trajectory):
                read_trajectory(Path(settings.trajectory).expanduser())
        for scene, path, settings in zip(self.scenes, files, chosen, strict=True):
            yield str(path), out / scene, settings


PRESETS = {
    # How weak the paper's light is, it does not say.
    "synthetic_nerf_dark": Preset(
        SYNTHETIC_NERF,
        lambda source, scene: {"light": 0.02, "width": 800, "samples": 256, "trajectory": str(source / scene)},
    ),
    # Nor the size of these pictures; LLFF's at a quarter.
    "low_texture_blender": Preset(
        tuple(LOW_TEXTURE),
        lambda source, scene: {"width": 1008, "height": 756, "samples": 512, "trajectory": "forward", "views": 49},
    ),
}
