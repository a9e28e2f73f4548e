"""COLMAP's reconstructions: the binary model in ``sparse/0`` beside its pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ctm_plugin.data.bounds import depth_bounds, depths_seen
from ctm_plugin.data.config import BoundsConfig, CaptureConfig
from ctm_plugin.data.geometry import given_bounds, make_scene, ray_bounds
from ctm_plugin.data.photographs import (
    Photograph,
    Pictures,
    develop_photographs,
    every,
    existing,
    find_listed,
    find_pictures,
    masks_beside,
)
from ctm_plugin.data.readers.colmap_model import read_cameras, read_images
from ctm_plugin.data.readers.folders import inside
from ctm_plugin.data.readers.layouts import MODELS, model_folder, open_layout
from ctm_plugin.errors import DataError
from ctm_plugin.scene.views import Scene
from ctm_plugin.settings.build import REQUIRED, setting
from ctm_plugin.settings.check import Number


@dataclass(frozen=True, kw_only=True)
class ColmapConfig(CaptureConfig, BoundsConfig):
    """COLMAP's binary model, sparse/0 or sparse, beside images, or images_<downscale> where that is there."""

    root: str | Path = setting(REQUIRED, "folder with sparse and images")
    images: str | None = setting(
        None, "folder of the pictures in root; null: images, else the only one with their names"
    )
    near: Number | None = setting(
        BoundsConfig.near, "bounds along the rays in COLMAP's units; null: from the points that pictures see"
    )

    def load(self) -> Scene:
        """Read a reconstruction of COLMAP's.

        Pictures that are registered but missing are left out, with one warning.

        Returns:
            The scene, named as its folder, in COLMAP's units unless ``geometry`` is forward.

        Raises:
            DataError, ConfigError: see :meth:`ctm_plugin.data.blender.BlenderConfig.load`.
        """
        root = open_layout(self.root, "colmap", self.links)
        model = find_model(root)
        cameras_file, source, points = (
            inside(root, f"{model}/{name}.bin") for name in ("cameras", "images", "points3D")
        )
        cameras = read_cameras(cameras_file)
        taken = sorted(read_images(source, cameras), key=lambda picture: picture.name)
        pictures = picture_folder(root, self, [picture.name for picture in taken])
        folder = pictures.folder.relative_to(root)
        paths = [find_listed(root, f"{folder}/{picture.name}", source) for picture in taken]
        there = existing(paths, [picture.name for picture in taken], source)
        masks = masks_beside(root, pictures.folder, [paths[i] for i in there])
        photographs = [
            Photograph(paths[i], taken[i].c2w, cameras[taken[i].camera], mask)
            for i, mask in zip(there, masks, strict=True)
        ]
        testing = every(self.test_every, len(there))
        train, test = develop_photographs(photographs, testing, pictures, self, cameras_file)

        def seen() -> tuple[float, float]:
            found = depth_bounds(depths_seen([taken[i] for i in there], points))
            if found is None:
                raise DataError(points, "no points that the pictures see", "some, or dataset.near and dataset.far")
            return ray_bounds(*found, self.geometry, train)

        near, far = given_bounds(self, [], seen, points)
        return make_scene(root, self, train, test, near, far)


def find_model(root: Path) -> str:
    """Find the folder of the binary model, as a name in ``root``.

    Raises:
        DataError: the model is text.
    """
    folder = model_folder(root)
    if folder is None:
        return MODELS[0]
    if not (folder / "cameras.bin").exists():
        command = f"colmap model_converter --input_path {folder} --output_path {folder} --output_type BIN"
        raise DataError(folder / "cameras.txt", "a model as text", f"a binary one: {command}")
    return str(folder.relative_to(root))


def picture_folder(root: Path, config: ColmapConfig, names: Sequence[str]) -> Pictures:
    """Find the pictures: in ``config.images``, else ``images``, else the only folder that holds the model's names.

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
                root, f"pictures in {', '.join(found)}", " or ".join(f"dataset.images={name}" for name in found)
            )
        if found:
            return Pictures(root / found[0], shrunk=False)
    return find_pictures(root, config.whole_factor)
