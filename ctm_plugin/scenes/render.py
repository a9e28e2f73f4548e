"""Render a scene into a folder that the loaders read; see docs/scenes.md for the files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from ctm_plugin.errors import DataError
from ctm_plugin.files import write_json, write_text
from ctm_plugin.scenes import cycles
from ctm_plugin.scenes.encode import DEPTH_SCALE, decode_depth, encode_depth, to_rgba8, write_npy, write_png
from ctm_plugin.scenes.layouts import axial_bounds, depth_path, view_path, write_poses_bounds, write_transforms
from ctm_plugin.scenes.plan import Plan, plan
from ctm_plugin.scenes.settings import RenderSettings

SETTINGS_FILE, README, HASHES = "settings.json", "README.md", "SHA256SUMS"


def render(scene: str, out: Path, settings: RenderSettings) -> None:
    """Render into ``out``; pictures that are already there are kept, so a stopped run goes on where it was.

    Args:
        scene: a registered scene by name, or a path to a ``.blend`` file.
        out: folder, made if missing.
        settings: how.

    Raises:
        UnknownNameError: there is no such scene.
        CTMError: Blender's module is missing, or the scene or its trajectory cannot be used.
        DataError: ``out`` holds other files, or pictures of another scene or other settings.
    """
    version = cycles.require_bpy().app.version_string
    with cycles.quiet(), progress_bar() as progress:
        work = plan(scene, settings)
        claim(out, {"scene": work.source, **resolved(work, settings), "blender": version})
        Rendering(work, out, settings, progress).run()


class Rendering:
    """The pictures of one plan.

    Args:
        work: scene and cameras.
        out: a claimed folder.
        settings: how.
        progress: where to show how far it is.
    """

    def __init__(self, work: Plan, out: Path, settings: RenderSettings, progress: Progress):
        self.work, self.out, self.settings, self.progress = work, out, settings, progress
        self.suffix = ".npy" if settings.depth == "float" else ".png"
        # Of views around an object only those for testing need a depth; LLFF wants the bounds of every view.
        self.measured = [split for split in work.cameras if split != "train"]
        total = sum(len(poses) for poses in work.cameras.values())
        total += sum(len(work.cameras[split]) for split in self.measured)
        self.task = progress.add_task(f"{work.name} light {settings.light:g}", total=total)

    def run(self) -> None:
        """Take every picture that is not there yet, then write down what the folder holds."""
        work, settings = self.work, self.settings
        cycles.empty_scene(work.build)
        cycles.dim(settings.light)
        cycles.set_up_cycles(*settings.size, work.camera_angle_x, work.near, work.far, settings.device)
        cycles.use_radiance(settings.samples, settings.seed, settings.denoise, work.transparent)
        for split in work.cameras:
            self.take(split, view_path, self.color)
        cycles.use_distance()
        for split in self.measured:
            self.take(split, self.depth_file, self.depth)
        # Written last: a folder with poses is a whole data set.
        self.write_cameras()
        write_manifest(self.out)

    def take(self, split: str, path_of: Callable, image: Callable[[], np.ndarray]) -> None:
        """Write ``image()``, ``[H, W, C]`` or ``[H, W]``, from each camera of a split, unless its file is there."""
        for index, pose in enumerate(self.work.cameras[split]):
            path = path_of(self.out, split, index)
            if not path.exists():
                path.parent.mkdir(parents=True, exist_ok=True)
                cycles.place_camera(pose)
                (write_npy if path.suffix == ".npy" else write_png)(path, image())
            self.progress.advance(self.task)

    def color(self) -> np.ndarray:
        """Render ``[H, W, 3 or 4]``: 8-bit sRGB, alpha where the scene ends."""
        rgba = to_rgba8(cycles.picture())
        return rgba if self.work.transparent else rgba[..., :3]

    def depth(self) -> np.ndarray:
        """Render the distance along the rays, ``[H, W]``, as its file holds it."""
        found = distance(cycles.picture())
        return found if self.suffix == ".npy" else encode_depth(found)

    def depth_file(self, out: Path, split: str, index: int) -> Path:
        return depth_path(out, split, index, self.suffix)

    def distances(self, split: str, index: int) -> np.ndarray:
        """Read distances ``[H, W]`` in scene units, as written; NaN for nothing."""
        path = self.depth_file(self.out, split, index)
        return np.load(path, allow_pickle=False) if self.suffix == ".npy" else decode_depth(iio.imread(path))

    def write_cameras(self) -> None:
        work, cameras = self.work, self.work.cameras
        if work.forward:
            views = range(len(cameras["all"]))
            bounds = np.array([axial_bounds(self.distances("all", i), work.camera_angle_x) for i in views])
            # A view of nothing but sky has the bounds of the others.
            bounds = np.where(np.isnan(bounds), [np.nanmin(bounds[:, 0]), np.nanmax(bounds[:, 1])], bounds)
            write_poses_bounds(self.out, cameras["all"], work.camera_angle_x, self.settings.size, bounds)
            return
        near, far = work.near, work.far
        if near is None or far is None:
            seen = np.stack([self.distances("test", i) for i in range(len(cameras["test"]))])
            near, far = 0.9 * float(np.nanmin(seen)), 1.1 * float(np.nanmax(seen))
        for split, poses in cameras.items():
            write_transforms(self.out, split, poses, work.camera_angle_x, near, far, self.suffix)


def resolved(work: Plan, settings: RenderSettings) -> dict[str, object]:
    """Collect all settings that the pictures depend on, with the scene's own numbers in place of the defaults."""
    width, height = settings.size
    views, test_views = (len(work.cameras.get(split, ())) for split in ("all" if work.forward else "train", "test"))
    said = {"width": width, "height": height, "views": views, "test_views": test_views}
    said["depth_scale"] = 1.0 if settings.depth == "float" else DEPTH_SCALE
    return {key: value for key, value in (asdict(settings) | said).items() if key != "device"}


def progress_bar() -> Progress:
    """Make a bar with counts, time passed and time left, on the standard error."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    return Progress(*columns, TextColumn("left"), TimeRemainingColumn(), console=Console(stderr=True))


def distance(image: np.ndarray) -> np.ndarray:
    """Take depth out of a distance rendering: ``[H, W, 4]`` to ``[H, W]``, NaN where the ray hit nothing."""
    return np.where(image[..., 3] > 0.5, image[..., 0], np.nan).astype(np.float32)


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


def write_manifest(out: Path) -> None:
    """Write ``SHA256SUMS`` (``sha256sum -c`` checks it) and ``README.md`` into a rendering's folder."""
    files = sorted(
        path
        for path in out.rglob("*")
        if path.is_file() and path.name not in (README, HASHES) and not path.name.startswith(".")
    )
    lines = [f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.relative_to(out).as_posix()}\n" for path in files]
    sums = "".join(lines)
    write_text(out / HASHES, sums)
    settings = json.loads((out / SETTINGS_FILE).read_text())
    rows = "".join(f"| {key} | {value} |\n" for key, value in settings.items())
    write_text(
        out / README,
        f"# {settings['scene']}\n\n"
        "Rendered with Blender's Cycles by `python -m ctm_plugin scenes`. Pictures: 8-bit sRGB of linear "
        "radiance cut at 1, without tone mapping. Depth: distance along the ray in scene units.\n\n"
        f"| setting | |\n|---|---|\n{rows}\n"
        f"{len(files)} files; sha256 of `{HASHES}`: `{hashlib.sha256(sums.encode()).hexdigest()}`\n",
    )
