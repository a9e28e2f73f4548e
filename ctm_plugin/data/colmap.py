"""COLMAP's reconstructions: the model in ``sparse/0`` next to its pictures."""

from __future__ import annotations

import shlex
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from ctm_plugin.data.bounds import bounds_of, bounds_of_cameras
from ctm_plugin.data.config import BoundsConfig, CaptureConfig, settled
from ctm_plugin.data.geometry import given_bounds, make_scene, ray_bounds
from ctm_plugin.data.photographs import (
    Photograph,
    Pictures,
    develop_photographs,
    every,
    existing,
    find_listed,
    find_pictures,
    first_of,
    masks_beside,
)
from ctm_plugin.data.points import first_points, read_cloud
from ctm_plugin.data.readers.colmap_model import is_as_shown, model_file, read_cameras, read_images, usable
from ctm_plugin.data.readers.folders import inside, is_picture
from ctm_plugin.data.readers.layouts import MODELS, model_folders, open_layout
from ctm_plugin.data.rig import Rig, rig_of
from ctm_plugin.errors import DataError
from ctm_plugin.scene.views import Scene
from ctm_plugin.settings.build import REQUIRED, setting
from ctm_plugin.settings.check import Number


@dataclass(frozen=True, kw_only=True)
class ColmapConfig(CaptureConfig, BoundsConfig):
    """COLMAP's model, sparse/0 or sparse, binary or text, next to images, or images_<downscale> if there is one."""

    default_backbone = "splat"

    root: str | Path = setting(REQUIRED, "folder with sparse and images")
    images: str | None = setting(
        None, "folder of the pictures in root; null: images, or the only folder with pictures of the right names"
    )
    near: Number | None = setting(
        BoundsConfig.near,
        "distance at which rays begin, in COLMAP's units; null: from the points that the pictures see, else from "
        "the cameras",
    )

    def rig(self) -> Rig:
        root = open_layout(self.root, "colmap", self.links)
        files = [model_file(model_folders(root)[0], name) for name in ("cameras", "images", "points3D")]
        cameras = read_cameras(files[0])
        taken = usable(read_images(files[1], cameras))
        pictures = picture_folder(root, self, [picture.name for picture in taken])
        used = [cameras[number] for number in {picture.camera for picture in taken}]
        found = bounds_of(read_cloud("", taken, files[2]), ()) if files[2].exists() else None
        return rig_of(used, [each.c2w for each in taken], *first_of(pictures, self), found and found[0])

    def load(self) -> Scene:
        """Read a reconstruction of COLMAP's.

        The model lies in ``sparse/0``, ``sparse``, ``colmap/sparse/0``, ``colmap_sparse/0`` or ``colmap_text``. Of
        several models, that in ``sparse/0`` is taken, with a warning. Cameras are ``SIMPLE_PINHOLE``, ``PINHOLE``,
        ``SIMPLE_RADIAL``, ``RADIAL``, ``OPENCV``, or ``FULL_OPENCV`` without k4 to k6; others are refused.

        Rays are undistorted, pictures stay as they are. A picture has its camera's size, or the same at another scale;
        ``crop`` says how others were cut. Masks lie in a folder ``masks`` next to ``images``.

        Pictures that are registered but missing are left out, with one warning.

        Returns:
            The scene, named as its folder, in COLMAP's units unless ``geometry`` is forward.

        Raises:
            DataError, ConfigError: see :meth:`ctm_plugin.data.blender.BlenderConfig.load`.
        """
        self = settled(self)
        root = open_layout(self.root, "colmap", self.links)
        model = find_model(root)
        cameras_file, source, points = (model_file(model, name) for name in ("cameras", "images", "points3D"))
        cameras = read_cameras(cameras_file)
        listed = read_images(source, cameras)
        taken = sorted(usable(listed), key=lambda picture: picture.name)
        pictures = picture_folder(root, self, [picture.name for picture in taken])
        folder = pictures.folder.relative_to(root)
        names = [picture.name for picture in taken]
        if not (pictures.folder / "images").is_dir():  # COLMAP may have been shown the folder above
            names = [name.removeprefix("images/") for name in names]
        paths = [find_listed(root, f"{folder}/{name}", source) for name in names]
        there = existing(root, paths, names, source)
        tell_of_others(pictures.folder, len(listed))
        masks = masks_beside(root, [paths[i].relative_to(pictures.folder) for i in there])
        shown = is_as_shown(model)
        photographs = [
            Photograph(paths[i], taken[i].c2w, cameras[taken[i].camera], mask, shown=shown)
            for i, mask in zip(there, masks, strict=True)
        ]
        testing = every(self.test_every, len(there))
        train, test = develop_photographs(photographs, testing, pictures, self, cameras_file)
        taken = [taken[i] for i in there]
        cloud = cache(lambda: (read_cloud(points.stem, taken, points), ""))  # read once, also where bounds are given

        def seen() -> tuple[float, float]:
            found = bounds_of(cloud()[0], (train, test)) if points.exists() else None
            if found is not None:
                return ray_bounds(*found, self.geometry, train)
            poses = np.stack([picture.c2w for picture in taken])
            return bounds_of_cameras(points, poses, self.geometry, "no points that the pictures see")

        near, far = given_bounds(self, [], seen, points)
        names = [taken[i].name for i in self.trained_on(testing)]
        return make_scene(root, self, train, test, near, far, first_points(names, cloud))


def find_model(root: Path) -> Path:
    """Find the folder of the model; one warning names others next to it."""
    folders = model_folders(root)
    if len(folders) > 1 and folders[0].parent == folders[1].parent:
        others = ", ".join(path.name for path in folders[1:])
        told = f"the model in {folders[0].name} is used, {others} not: COLMAP could not join them"
        warnings.warn(f"{folders[0].parent}: {told}", stacklevel=3)
    return folders[0] if folders else root / MODELS[0]


def tell_of_others(folder: Path, known: int) -> None:
    """Warn of pictures in that folder, or in ``input`` next to it (3DGS), that a model of so many leaves out."""
    for each in (folder, folder.with_name("input")):
        count = sum(map(is_picture, each.rglob("*"))) if each.is_dir() else 0
        if count > known:
            told = f"the model has the cameras of {known} of {count} pictures; the others are not trained on"
            warnings.warn(f"{each}: {told}", stacklevel=3)
            return


def picture_folder(root: Path, config: ColmapConfig, names: Sequence[str]) -> Pictures:
    """Find the pictures: in ``config.images``, else ``images``, else the only folder with the names, else ``root``.

    Raises:
        DataError: there is none, or more than one; the message names them.
    """
    if config.images is not None:
        folder = inside(root, config.images, root)
        if not folder.is_dir():
            raise DataError(folder, "no such folder", "the folder of the pictures (dataset.images)")
        return Pictures(folder, shrunk=False)
    if names and not any(path.is_dir() for path in root.glob("images*")):
        found = sorted(path.name for path in root.iterdir() if path.is_dir() and find_listed(path, names[0], root))
        if len(found) > 1:
            raise DataError(
                root,
                f"pictures in {', '.join(found)}",
                " or ".join(f"dataset.images={shlex.quote(name)}" for name in found),
            )
        if found or find_listed(root, names[0], root):
            return Pictures(root / found[0] if found else root, shrunk=False)
    return find_pictures(root, config.whole_factor)
