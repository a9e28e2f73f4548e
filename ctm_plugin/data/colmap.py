"""COLMAP's reconstructions: the model in ``sparse/0`` next to its pictures."""

from __future__ import annotations

import shlex
import warnings
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from ctm_plugin.data.capture import Capture, Photograph
from ctm_plugin.data.load import Layout
from ctm_plugin.data.photographs import every_nth, existing, find_listed, find_pictures, masks_beside
from ctm_plugin.data.points import PointsOrReason, read_cloud
from ctm_plugin.data.readers.colmap_model import (
    is_as_shown,
    model_file,
    read_cameras,
    read_images,
    searched_in,
    usable,
)
from ctm_plugin.data.readers.folders import inside, is_picture
from ctm_plugin.data.readers.images import read_picture
from ctm_plugin.data.readers.layouts import MODEL_FOLDERS, model_folders, open_layout
from ctm_plugin.data.settings import ColmapSettings
from ctm_plugin.errors import DataError


class ColmapConfig(Layout, ColmapSettings):
    layout = "colmap"

    def capture(self) -> Capture:
        """Read a reconstruction of COLMAP's.

        The model lies in ``sparse/0``, ``sparse``, ``colmap/sparse/0``, ``colmap_sparse/0`` or ``colmap_text``. Of
        several models, that in ``sparse/0`` is taken, with a warning. Cameras are ``SIMPLE_PINHOLE``, ``PINHOLE``,
        ``SIMPLE_RADIAL``, ``RADIAL``, ``OPENCV``, or ``FULL_OPENCV`` without k4 to k6; others are refused.

        Rays are undistorted, pictures stay as they are. A picture has its camera's size, or the same at another scale.
        Masks lie in a folder ``masks`` next to ``images``.

        Pictures that are registered but missing are left out, with one warning.
        """
        root = open_layout(self.root, self.layout)
        model = find_model(root)
        cameras_file, source, points = (model_file(model, name) for name in ("cameras", "images", "points3D"))
        cameras = read_cameras(cameras_file)
        listed = read_images(source, cameras)
        taken = sorted(usable(listed), key=lambda picture: picture.name)
        folder, shrunk = picture_folder(root, self, [picture.name for picture in taken])
        names = [picture.name for picture in taken]
        if not (folder / "images").is_dir():  # COLMAP may have been shown the folder above
            names = [name.removeprefix("images/") for name in names]
        paths = [find_listed(root, f"{folder.relative_to(root)}/{name}", source) for name in names]
        there = existing(root, paths, names, source)
        tell_of_others(folder, len(listed), len(searched_in(model)))
        taken, paths = [taken[i] for i in there], [paths[i] for i in there]
        masks, shown = masks_beside(root, [path.relative_to(folder) for path in paths]), is_as_shown(model)
        photographs = [
            Photograph(path, each.name, each.c2w, cameras[each.camera], read_picture(path), mask, shown=shown)
            for path, each, mask in zip(paths, taken, masks, strict=True)
        ]

        @cache
        def cloud() -> PointsOrReason:
            return (read_cloud(points.stem, taken, points), "") if points.exists() else (None, "")

        return Capture(
            root,
            cameras_file,
            photographs,
            every_nth(self.test_every, len(photographs)),
            shrunk,
            clouds=[cloud],
            lacking=(points, "no points that the pictures see"),
        )


def find_model(root: Path) -> Path:
    """Find the folder of the model; one warning names others next to it."""
    folders = model_folders(root)
    if len(folders) > 1 and folders[0].parent == folders[1].parent:
        others = ", ".join(path.name for path in folders[1:])
        warning = f"the model in {folders[0].name} is used, {others} not: COLMAP could not join them"
        warnings.warn(f"{folders[0].parent}: {warning}", stacklevel=3)
    return folders[0] if folders else root / MODEL_FOLDERS[0]


def tell_of_others(folder: Path, known: int, searched: int) -> None:
    """Warn of pictures in ``folder``, or in ``input`` next to it (3DGS), that a model of ``known`` ones leaves out.

    Where ``ctm cameras`` made the model, of those ``searched``: it says itself what it left out before.
    """
    for each in (folder, folder.with_name("input")):
        count = searched or (sum(map(is_picture, each.rglob("*"))) if each.is_dir() else 0)
        if count > known:
            warning = f"the model has the cameras of {known} of {count} pictures; the others are not trained on"
            warnings.warn(f"{each}: {warning}", stacklevel=3)
            return


def picture_folder(root: Path, config: ColmapConfig, names: Sequence[str]) -> tuple[Path, bool]:
    """Find the pictures: in ``config.images``, else ``images``, else the only folder with the names, else ``root``.

    Raises a DataError where ``config.images`` is not there, or several folders have the names.
    """
    if config.images is not None:
        folder = inside(root, config.images, root)
        if not folder.is_dir():
            raise DataError(folder, "no such folder", "the folder of the pictures (dataset.images)")
        return folder, False
    if names and not any(path.is_dir() for path in root.glob("images*")):
        folders = sorted(path.name for path in root.iterdir() if path.is_dir() and find_listed(path, names[0], root))
        if len(folders) > 1:
            raise DataError(
                root,
                f"pictures in {', '.join(folders)}",
                " or ".join(f"dataset.images={shlex.quote(name)}" for name in folders),
            )
        if folders or find_listed(root, names[0], root):
            return root / folders[0] if folders else root, False
    return find_pictures(root, config.whole_factor)
