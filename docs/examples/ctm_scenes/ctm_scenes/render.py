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
from rich.progress import MofNCompleteColumn, Progress

from ctm_plugin.errors import DataError
from ctm_plugin.files import write_json, write_text
from ctm_scenes import cycles
from ctm_scenes import layouts as files
from ctm_scenes.plan import Plan, plan
from ctm_scenes.settings import RenderSettings

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
    columns = (*Progress.get_default_columns(), MofNCompleteColumn())
    with cycles.quiet(), Progress(*columns, console=Console(stderr=True)) as progress:
        work = plan(scene, settings)
        claim(out, {"scene": work.source, **resolved(work, settings), "blender": version})
        Rendering(work, out, settings, progress).run()


class Rendering:
    """The pictures of one plan, to be put into a claimed folder."""

    def __init__(self, work: Plan, out: Path, settings: RenderSettings, progress: Progress):
        self.work, self.out, self.settings, self.progress = work, out, settings, progress
        # Of views around an object only those for testing need a depth; LLFF wants the bounds of every view.
        self.measured = [split for split in work.cameras if split != "train"]
        total = sum(len(work.cameras[split]) for split in [*work.cameras, *self.measured])
        self.task = progress.add_task(f"{work.name} light {settings.light:g}", total=total)

    def run(self) -> None:
        """Take every picture that is not there yet, then write down what the folder holds."""
        work, settings = self.work, self.settings
        cycles.empty_scene(work.build)
        cycles.dim(settings.light)
        cycles.set_up_cycles(*settings.size, work.camera_angle_x, work.near, work.far, settings.device)
        cycles.use_radiance(settings.samples, settings.seed, settings.denoise, work.transparent)
        for split in work.cameras:
            self.take(split, files.view_path, self.color)
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
                (files.write_npy if path.suffix == ".npy" else files.write_png)(path, image())
            self.progress.advance(self.task)

    def color(self) -> np.ndarray:
        """Render ``[H, W, 3 or 4]``: 8-bit sRGB, alpha where the scene ends."""
        return files.to_rgba8(cycles.picture())[..., : 4 if self.work.transparent else 3]

    def depth(self) -> np.ndarray:
        """Render the distance along the rays, ``[H, W]``, as its file holds it."""
        found = distance(cycles.picture())
        return found if self.settings.depth == "float" else files.encode_depth(found)

    def depth_file(self, out: Path, split: str, index: int) -> Path:
        return files.depth_path(out, split, index).with_suffix(".npy" if self.settings.depth == "float" else ".png")

    def write_cameras(self) -> None:
        """Write the poses, with the bounds of what the depth files hold where the scene has none of its own."""
        work, cameras, near, far = self.work, self.work.cameras, self.work.near, self.work.far
        if work.forward or near is None or far is None:
            paths = [self.depth_file(self.out, split, i) for split in self.measured for i in range(len(cameras[split]))]
            seen = [np.load(path) if path.suffix == ".npy" else files.decode_depth(iio.imread(path)) for path in paths]
        if work.forward:
            bounds = np.array([files.axial_bounds(each, work.camera_angle_x) for each in seen])
            # A view of nothing but sky has the bounds of the others.
            bounds = np.where(np.isnan(bounds), [np.nanmin(bounds[:, 0]), np.nanmax(bounds[:, 1])], bounds)
            files.write_poses_bounds(self.out, cameras["all"], work.camera_angle_x, self.settings.size, bounds)
            return
        if near is None or far is None:
            near, far = 0.9 * float(np.nanmin(seen)), 1.1 * float(np.nanmax(seen))
        for split, poses in cameras.items():
            files.write_transforms(self.out, split, poses, work.camera_angle_x, near, far, self.settings.depth)


def resolved(work: Plan, settings: RenderSettings) -> dict[str, object]:
    """Collect all settings that the pictures depend on, with the scene's own numbers in place of the defaults."""
    width, height = settings.size
    views, test_views = (len(work.cameras.get(split, ())) for split in ("all" if work.forward else "train", "test"))
    said = {"width": width, "height": height, "views": views, "test_views": test_views}
    said["depth_scale"] = files.scale_of(settings.depth)
    return {key: value for key, value in (asdict(settings) | said).items() if key != "device"}


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
    if not path.exists():
        if out.exists() and any(out.iterdir()):
            raise DataError(out, f"files but no {SETTINGS_FILE}", "an empty folder or an unfinished rendering")
        out.mkdir(parents=True, exist_ok=True)
        return write_json(path, settings)
    try:
        found = dict(json.loads(path.read_text()))
    except (ValueError, TypeError) as error:
        raise DataError(path, f"no settings ({error})", "the JSON object that the renderer wrote") from error
    if other := [key for key in settings if found.get(key) != settings[key]]:
        held, wanted = (", ".join(f"{key}={each.get(key)}" for key in other) for each in (found, settings))
        raise DataError(out, f"a rendering with {held}", f"one with {wanted}, or an empty folder")


def write_manifest(out: Path) -> None:
    """Write ``SHA256SUMS`` (``sha256sum -c`` checks it) and ``README.md`` into a rendering's folder."""
    left = (README, HASHES)
    paths = sorted(p for p in out.rglob("*") if p.is_file() and p.name not in left and not p.name.startswith("."))
    lines = [f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.relative_to(out).as_posix()}\n" for path in paths]
    write_text(out / HASHES, "".join(lines))
    settings = json.loads((out / SETTINGS_FILE).read_text())
    rows = "".join(f"| {key} | {value} |\n" for key, value in settings.items())
    write_text(
        out / README,
        f"# {settings['scene']}\n\n"
        "Rendered with Blender's Cycles by `python -m ctm_plugin scenes`. Pictures: 8-bit sRGB of linear "
        "radiance cut at 1, without tone mapping. Depth: distance along the ray in scene units.\n\n"
        f"| setting | |\n|---|---|\n{rows}\n"
        f"{len(paths)} files; sha256 of `{HASHES}`: `{hashlib.sha256(''.join(lines).encode()).hexdigest()}`\n",
    )
