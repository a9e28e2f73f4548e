"""The layout of LLFF: ``poses_bounds.npy`` next to ``images``, taken by hand in front of a scene."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64
from torch import Tensor

from ctm_plugin.data.bounds import bounds_of_cameras
from ctm_plugin.data.config import BoundsConfig, CaptureConfig, settled
from ctm_plugin.data.develop import develop_depth
from ctm_plugin.data.geometry import given_bounds, make_scene, ray_bounds
from ctm_plugin.data.photographs import (
    Photograph,
    Pictures,
    develop_photographs,
    every,
    find_pictures,
    first_of,
    masks_beside,
)
from ctm_plugin.data.points import first_points, model_beside
from ctm_plugin.data.readers.folders import inside, is_picture
from ctm_plugin.data.readers.images import map_numbers
from ctm_plugin.data.readers.layouts import POSES, model_folder, open_layout
from ctm_plugin.data.readers.lens import Camera
from ctm_plugin.data.readers.renderings import read_depth_scale
from ctm_plugin.data.rig import Rig, rig_of
from ctm_plugin.errors import DataError
from ctm_plugin.scene.poses import MAX_COORDINATE, check_rotation
from ctm_plugin.scene.views import Scene
from ctm_plugin.settings.build import REQUIRED, setting
from ctm_plugin.settings.check import Number, check_integer

STRAY = 5.0
"""How far beyond the median of all fars one is that of bad points."""


@dataclass(frozen=True, kw_only=True)
class LLFFConfig(CaptureConfig, BoundsConfig):
    """LLFF's layout: poses_bounds.npy next to a folder images, or images_<downscale> if there is one."""

    root: str | Path = setting(REQUIRED, "folder with poses_bounds.npy and images")
    factor: int | None = setting(
        None,
        "read pictures of images_<factor>, or of images with 1, then shrink them by downscale; null: "
        "images_<downscale>, else images",
    )
    near: Number | None = setting(
        BoundsConfig.near, "distance at which rays begin; null: the file's, else from the cameras"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.factor is not None:
            check_integer("dataset.factor", self.factor, 1)

    def rig(self) -> Rig:
        root = open_layout(self.root, "llff", self.links)
        c2w, hwf, bounds = read_poses(inside(root, POSES), bounded=True)
        cameras = {Camera(w, h, focal, focal, 0.5 * w, 0.5 * h) for h, w, focal in hwf.tolist()}
        return rig_of(
            cameras,
            list(c2w),
            *first_of(find_pictures(root, self.whole_factor, self.factor), self),
            near=None if bounds is None else float(np.nanmin(bounds)),  # NaN: rows of pictures that see no points
        )

    def load(self) -> Scene:
        """Read a data set in LLFF layout.

        Files without bounds, or with zeros or NaN in them, get bounds from the cameras, with a warning. Single rows
        without bounds are left out, and so are those with a far of more than five medians, except under ``forward``.

        Test views have depth where a folder ``depth`` holds it: ``.npy`` in units of the file's poses, or 16-bit PNG
        with ``depth_scale`` in ``settings.json``.

        Returns:
            The scene, named as its folder. Forward-facing it is moved and scaled, see
            :func:`~ctm_plugin.data.geometry.settle`; else it keeps the file's units and near lies a little in front of
            the nearest bound. Far is a distance along the rays that holds all that the bounds hold.

        Raises:
            DataError, ConfigError: see :meth:`ctm_plugin.data.blender.BlenderConfig.load`.
        """
        self = settled(self)
        root = open_layout(self.root, "llff", self.links)
        pictures = find_pictures(root, self.whole_factor, self.factor)
        return posed_scene(root, pictures, pictures.listing(root), self)


def posed_scene(root: Path, pictures: Pictures, paths: list[Path], config: LLFFConfig) -> Scene:
    """The scene out of pictures and the rows of ``poses_bounds.npy``, one for each in the order of their names.

    Raises:
        DataError, ConfigError: see :meth:`LLFFConfig.load`.
    """
    source = inside(root, POSES)
    c2w, hwf, bounds = read_poses(source, bounded=config.near is None or config.far is None)
    if len(paths) != len(c2w):
        raise DataError(
            source, f"{len(c2w)} poses", f"{len(paths)}, one for each picture in {paths[0].parent}{which(root)}"
        )
    photographs = [
        Photograph(path, pose, Camera(width, height, focal, focal, 0.5 * width, 0.5 * height, where=f"row {row}"), mask)
        for row, (path, pose, (height, width, focal), mask) in enumerate(
            zip(paths, c2w, hwf.tolist(), masks_beside(root, [Path(path.name) for path in paths]), strict=True)
        )
    ]
    testing = every(config.test_every, len(photographs))
    train, test = develop_photographs(photographs, testing, pictures, config, source)
    tested = [path for path, chosen in zip(paths, testing, strict=True) if chosen]
    depth = read_depths(root, tested, test.height, test.width)

    def bound() -> tuple[float, float]:
        if bounds is None:
            return bounds_of_cameras(source, c2w, config.geometry, "no near and far there")
        return ray_bounds(*joint_bounds(bounds, config.geometry, source), config.geometry, train)

    near, far = given_bounds(config, [], bound, source)
    # LLFF names shrunk pictures anew, in the order of COLMAP's, which images has.
    whole = sorted(path for path in (root / "images").glob("*") if is_picture(path))
    named = whole if len(whole) == len(paths) else paths
    poses = [(path.name, pose) for path, pose in zip(named, c2w, strict=True)]
    names = [named[i].name for i in config.trained_on(testing)]
    points = first_points(names, lambda: model_beside(root, poses))
    return make_scene(root, config, train, replace(test, depth=depth), near, far, points)


def which(root: Path) -> str:
    """Say how to find the pictures that the poses of ``poses_bounds.npy`` are of; it does not name them."""
    if (root / "view_imgs.txt").is_file():
        return ": leave only those there that view_imgs.txt names"
    if model := model_folder(root):
        return f": dataset=colmap reads {model.relative_to(root)}, which names those that have one"
    return ": leave only those there that COLMAP placed, which its images.txt or view_imgs.txt names"


def joint_bounds(bounds: Float64[np.ndarray, "n 2"], geometry: Geometry, source: Path) -> tuple[float, float]:
    """Nearest and farthest depth of all rows; one warning tells of rows that are left out.

    Rows of NaN are of pictures that see no points. A far of more than ``STRAY`` medians is that of a few bad points,
    which would spoil a box; NDC has room for it.
    """
    seen = ~np.isnan(bounds[:, 0])
    stray = seen & (bounds[:, 1] > STRAY * np.median(bounds[seen, 1])) & (geometry != "forward")
    if not (seen & ~stray).all():
        rows = ", ".join(map(str, np.flatnonzero(~seen | stray)[:10]))
        told = (
            f"the bounds of rows {rows} are left out: they have no points, or a far beyond {STRAY:g} times the others'"
        )
        warnings.warn(f"{source}: {told}: dataset.near and dataset.far set them", stacklevel=2)
    near, far = bounds[seen & ~stray].T
    return float(near.min()), float(far.max())


def read_poses(
    source: Path, bounded: bool
) -> tuple[Float64[np.ndarray, "n 3 4"], Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 2"] | None]:
    """Camera to world with OpenGL axes, (height, width, focal length) in pixels, and the bounds.

    Args:
        source: the file.
        bounded: whether its bounds are asked for: ``None`` where no row has any. Rows without, of pictures that see no
            points, hold zeros, NaN or infinity in the file, and NaN here.

    Raises:
        DataError: a row is no pose, or its numbers are impossible.
    """
    expected = "an array [N, 17] of finite numbers: a 3x5 matrix, near and far of each view"
    rows = map_numbers(source, expected)
    if rows.shape[1:] == (3, 5):
        rows = rows.reshape(-1, 15)
    if rows.ndim != 2 or rows.shape[1] not in (15, 17) or not len(rows):
        raise DataError(source, f"an array {list(rows.shape)}", expected)
    rows = np.array(rows, dtype=np.float64)
    if not np.isfinite(rows[:, :15]).all():
        raise DataError(source, "NaN or infinity", expected)
    matrix, bounds = rows[:, :15].reshape(-1, 3, 5), rows[:, 15:]
    seen = np.isfinite(bounds).all(1) & bounds.any(1)
    bounds[~seen] = np.nan
    down, right, back, eye, hwf = np.moveaxis(matrix, -1, 0)
    c2w = np.stack([right, -down, back, eye], axis=-1)
    for index, pose in enumerate(c2w):
        check_rotation(pose[:, :3], source, f"row {index}")
        if np.abs(eye[index]).max() > MAX_COORDINATE:
            raise DataError(source, f"row {index} with a camera at {eye[index].tolist()}", f"below {MAX_COORDINATE:g}")
        if not (hwf[index] > 0).all():
            raise DataError(
                source, f"row {index} with height, width, focal length {hwf[index].tolist()}", "numbers > 0"
            )
    for index in np.flatnonzero(seen) if bounded else ():
        near, far = bounds[index].tolist()
        if not 0 < near < far <= MAX_COORDINATE:
            expected = "0 < near < far, or dataset.near and dataset.far"
            raise DataError(source, f"row {index} with bounds {near:g} and {far:g}", expected)
    return c2w, hwf, bounds if bounded and seen.any() else None


def read_depths(
    root: Path, pictures: list[Path], height: int, width: int
) -> Float32[Tensor, "n {height} {width}"] | None:
    """Distances along the rays in units of the poses; ``None`` where there is no folder ``depth``."""
    folder = root / "depth"
    if not folder.is_dir():
        return None
    paths = []
    for picture in pictures:
        names = [f"depth/{picture.stem}{suffix}" for suffix in (".npy", ".png")]
        found = [path for name in names if (path := inside(root, name)).is_file()]
        if not found:
            raise DataError(folder / picture.stem, "no depth", "a .npy or .png, or no folder depth at all")
        paths.append(found[0])
    return develop_depth(paths, read_depth_scale(root), height, width)
