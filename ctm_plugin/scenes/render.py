"""Render a scene into a folder in the layout of Synthetic-NeRF; see docs/scenes.md for the files."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from ctm_plugin.errors import ConfigError, DataError
from ctm_plugin.scenes import blender
from ctm_plugin.scenes.encode import DEPTH_SCALE, encode_depth, to_rgba8, write_json, write_png
from ctm_plugin.scenes.spec import Number, SceneSpec

SETTINGS_FILE = "settings.json"


@dataclass(frozen=True)
class RenderSettings:
    """How to render.

    Attributes:
        light: factor on every lamp and the world, > 0; 1 is normal light.
        size: width and height in pixels, 16 to 4096.
        samples: light paths a pixel, >= 1.
        seed: of the sampling and of the cameras' jitter, >= 0.
        views, test_views: pictures in each split, >= 1.

    Raises:
        ConfigError: a value is out of range.
    """

    light: Number = 1.0
    size: int = 128
    samples: int = 64
    seed: int = 0
    views: int = 100
    test_views: int = 25

    def __post_init__(self) -> None:
        if not (math.isfinite(self.light) and self.light > 0.0):
            raise ConfigError("light", self.light, "a number > 0, 1 being normal light")
        if not 16 <= self.size <= 4096:
            raise ConfigError("size", self.size, "pixels a side, an integer from 16 to 4096")
        # Blender keeps the seed in a signed 32-bit integer.
        if not 0 <= self.seed < 2**31:
            raise ConfigError("seed", self.seed, "an integer from 0 to 2147483647")
        for key in ("samples", "views", "test_views"):
            if getattr(self, key) < 1:
                raise ConfigError(key, getattr(self, key), "an integer >= 1")


def render(scene: SceneSpec, out: Path, settings: RenderSettings) -> None:
    """Render ``scene`` into ``out``; pictures that are already there are kept, so a stopped run goes on where it was.

    Args:
        scene: what to render.
        out: folder, made if missing.
        settings: how.

    Raises:
        CTMError: Blender's module is missing.
        DataError: ``out`` holds other files, or pictures of another scene or other settings.
    """
    bpy = blender.require_bpy()
    claim(out, {"scene": scene.name, **asdict(settings), "blender": bpy.app.version_string})
    poses = {
        "train": scene.train(settings.views, settings.seed),
        "test": scene.test(settings.test_views, settings.seed),
    }

    with blender.quiet(), progress_bar() as progress:
        blender.empty_scene(scene.build)
        blender.dim(settings.light)
        blender.set_up_cycles(settings.size, scene.camera_angle_x, scene.near, scene.far)
        total = settings.views + 2 * settings.test_views
        task = progress.add_task(f"{scene.name} light {settings.light:g}", total=total)

        def take(split: str, suffix: str, image: Callable[[], np.ndarray]) -> None:
            (out / split).mkdir(exist_ok=True)
            for index, pose in enumerate(poses[split]):
                path = out / split / f"r_{index}{suffix}.png"
                if not path.exists():
                    blender.place_camera(pose)
                    write_png(path, image())
                progress.advance(task)

        blender.use_radiance(settings.samples, settings.seed)
        take("train", "", lambda: to_rgba8(blender.picture()))
        take("test", "", lambda: to_rgba8(blender.picture()))
        blender.use_distance()
        take("test", "_depth", lambda: encode_depth(distance(blender.picture())))

    # Written last: a folder with transforms is a whole data set.
    for split in poses:
        write_json(out / f"transforms_{split}.json", transforms(scene, split, poses[split]))


def progress_bar() -> Progress:
    """A bar with counts, time passed and time left, on the standard error."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    return Progress(*columns, TextColumn("left"), TimeRemainingColumn(), console=Console(stderr=True))


def distance(image: np.ndarray) -> np.ndarray:
    """Depth out of a distance rendering: ``[H, W, 4]`` to ``[H, W]``, NaN where the ray hit nothing."""
    return np.where(image[..., 3] > 0.5, image[..., 0], np.nan)


def transforms(scene: SceneSpec, split: str, poses: np.ndarray) -> dict[str, object]:
    """The content of ``transforms_<split>.json``.

    Args:
        scene: gives field of view and bounds.
        split: ``train`` or ``test``; test frames also name their depth picture.
        poses: ``[N, 4, 4]`` camera to world.
    """
    frames = [{"file_path": f"./{split}/r_{i}", "transform_matrix": pose.tolist()} for i, pose in enumerate(poses)]
    content: dict[str, object] = {"camera_angle_x": scene.camera_angle_x, "near": scene.near, "far": scene.far}
    if split == "test":
        content["depth_scale"] = DEPTH_SCALE
        for frame in frames:
            frame["depth_file_path"] = f"{frame['file_path']}_depth.png"
    return {**content, "frames": frames}


def claim(out: Path, settings: dict[str, object]) -> None:
    """Make ``out`` this rendering's folder, or check that it is already.

    Raises:
        DataError: it is a file, holds files but no readable settings, or was rendered with other settings.
    """
    path = out / SETTINGS_FILE
    if out.exists() and not out.is_dir():
        raise DataError(out, "a file", "a folder to render into")
    if path.exists():
        try:
            found = dict(json.loads(path.read_text()))
        except (ValueError, TypeError) as error:
            raise DataError(path, f"no settings ({error})", "the JSON object that the renderer wrote") from error
        other = {key: found.get(key) for key in settings if found.get(key) != settings[key]}
        if other:
            wanted = ", ".join(f"{key}={settings[key]}" for key in other)
            held = ", ".join(f"{key}={value}" for key, value in other.items())
            raise DataError(out, f"a rendering with {held}", f"one with {wanted}, or an empty folder")
    elif out.exists() and any(out.iterdir()):
        raise DataError(out, f"files but no {SETTINGS_FILE}", "an empty folder or an unfinished rendering")
    else:
        out.mkdir(parents=True, exist_ok=True)
        write_json(path, settings)
