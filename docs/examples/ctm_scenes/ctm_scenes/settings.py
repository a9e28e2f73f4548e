"""The verb ``ctm scenes`` and its settings; neither Blender nor torch is needed to check them."""

from __future__ import annotations

from dataclasses import dataclass

from ctm_plugin.settings.commands import Verb
from ctm_plugin.settings.setting import REQUIRED, Settings, setting

LARGEST_SIZE = 8192


@dataclass(frozen=True, kw_only=True)
class Folders(Settings):
    """Where from and where to."""

    out: str = setting(REQUIRED, "folder to render into; it is made if missing")
    source: str | None = setting(None, "folder with the preset's .blend files")


@dataclass(frozen=True, kw_only=True)
class RenderSettings(Settings):
    """How to render."""

    light: float = setting(1.0, "factor on every lamp, the world and emitting materials; 1: normal light", above=0)
    width: int = setting(128, "width in pixels", least=16, most=LARGEST_SIZE)
    height: int = setting(0, "height in pixels; 0: the width", least=0, most=LARGEST_SIZE)
    samples: int = setting(32, "light paths a pixel", least=1)
    denoise: bool = setting(True, "clean the pictures with OpenImageDenoise")
    seed: int = setting(0, "seed of the sampling and of the cameras' jitter", least=0)
    views: int = setting(0, "number of training views; 0: the scene's own number", least=0)
    test_views: int = setting(
        0,
        "number of test views; 0: the scene's own; 0 on forward-facing scenes, where some of the views are for testing",
        least=0,
    )
    trajectory: str = setting(
        "own",
        "own (a .blend's is forward), hemisphere (around the origin), forward (a grid at the file's camera), or a "
        "folder with transforms_train.json and transforms_test.json",
    )
    extent: float = setting(
        0.2,
        "side of the grid of trajectory=forward, divided by the distance to what the file's camera sees",
        above=0,
        most=2,
    )
    background: str = setting(
        "own",
        "own, transparent or opaque: whether the world is visible behind the scene",
        choices=("own", "transparent", "opaque"),
    )
    depth: str = setting(
        "float",
        "float: float32 arrays; code: 16-bit pictures in steps of 1/4096, a tenth of the size",
        choices=("float", "code"),
    )
    device: str = setting("auto", "cpu, gpu, or auto: a GPU where there is one", choices=("auto", "cpu", "gpu"))

    def __post_init__(self) -> None:
        super().__post_init__()
        if 0 < self.height < 16:
            raise self.fault("height", f"pixels, from 16 to {LARGEST_SIZE}, or 0")

    @property
    def size(self) -> tuple[int, int]:
        """Give width and height in pixels."""
        return self.width, self.height or self.width


VERB = Verb(
    "make scenes with Blender",
    "SCENE",
    "ctm_scenes.command:scenes",
    "ctm_scenes.settings:Folders",
    "ctm_scenes.settings:RenderSettings",
)
