"""COLMAP's reconstructions: the binary model in ``sparse/0`` beside its pictures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ctm_plugin.data.config import BoundsConfig, CaptureConfig
from ctm_plugin.data.geometry import make_scene, ray_bounds
from ctm_plugin.data.photographs import (
    Photograph,
    develop_photographs,
    every,
    existing,
    find_listed,
    find_pictures,
    masks_beside,
)
from ctm_plugin.data.readers.colmap_model import Taken, read_cameras, read_images, read_points
from ctm_plugin.data.readers.folders import own, require_folder
from ctm_plugin.errors import DataError
from ctm_plugin.scene.poses import MAX_COORDINATE
from ctm_plugin.scene.views import Scene
from ctm_plugin.settings.build import REQUIRED, setting
from ctm_plugin.settings.check import Number

LOW, HIGH = 0.1, 99.9
"""Percentiles of the depths of the points that a picture sees, LLFF's: its nearest and farthest."""


@dataclass(frozen=True, kw_only=True)
class ColmapConfig(CaptureConfig, BoundsConfig):
    """COLMAP's binary model, sparse/0 or sparse, beside images, or images_<downscale> where that is there."""

    root: str | Path = setting(REQUIRED, "folder with sparse and images")
    near: Number | None = setting(
        BoundsConfig.near, "bounds along the rays in COLMAP's units; null: from the points that pictures see"
    )

    def load(self) -> Scene:
        """See :func:`load_colmap`."""
        return load_colmap(self)


def load_colmap(config: ColmapConfig) -> Scene:
    """Read a reconstruction of COLMAP's.

    Pictures that are registered but missing are left out, with one warning.

    Args:
        config: see :class:`ColmapConfig`.

    Returns:
        The scene, named as its folder, in COLMAP's units unless ``geometry`` is forward.

    Raises:
        DataError: a file is missing or cannot be used; the message names it, and the place in it.
        ConfigError: ``downscale`` or ``width`` do not suit the size, ``random_matched`` lacks alpha, or the cameras do
            not face forward as ``geometry`` says.
    """
    root = require_folder(config.root, "a folder with sparse/0 and images")
    model = "sparse/0" if (root / "sparse" / "0").is_dir() else "sparse"
    cameras_file, source, points = (own(root, f"{model}/{name}.bin") for name in ("cameras", "images", "points3D"))
    cameras = read_cameras(cameras_file)
    taken = sorted(read_images(source, cameras), key=lambda picture: picture.name)
    pictures = find_pictures(root, config.whole_factor)
    paths = [find_listed(root, f"{pictures.folder.name}/{picture.name}", source) for picture in taken]
    there = existing(paths, [picture.name for picture in taken], source)
    masks = masks_beside(root, pictures.folder, [paths[i] for i in there])
    photographs = [
        Photograph(paths[i], taken[i].c2w, cameras[taken[i].camera], mask) for i, mask in zip(there, masks, strict=True)
    ]
    testing = every(config.test_every, len(there))
    train, test = develop_photographs(photographs, testing, pictures, config, cameras_file)
    near, far = config.near, config.far
    if near is None or far is None:
        seen = ray_bounds(*depth_bounds([taken[i] for i in there], points), config.geometry, train)
        near, far = (found if given is None else given for given, found in zip((near, far), seen, strict=True))
    if near >= far:
        raise DataError(points, f"near {near:g}, far {far:g}", "near < far (dataset.near, dataset.far)")
    return make_scene(root, config, train, test, float(near), float(far))


def depth_bounds(taken: list[Taken], path: Path) -> tuple[float, float]:
    """The nearest and farthest depth of what the pictures see: percentiles of each, then the least and the largest.

    Raises:
        DataError: the points cannot be read, or no picture sees any in front of it.
    """
    numbers, positions = read_points(path)
    bounds = []
    for picture in taken if len(numbers) else []:
        place = np.searchsorted(numbers, picture.points).clip(max=len(numbers) - 1)
        seen = positions[place[numbers[place] == picture.points]]
        depth = -(seen - picture.c2w[:, 3]) @ picture.c2w[:, 2]
        depth = depth[(depth > 0) & (depth <= MAX_COORDINATE)]
        if len(depth):
            bounds.append(np.percentile(depth, (LOW, HIGH)))
    if not bounds:
        raise DataError(path, "no points that the pictures see", "some, or dataset.near and dataset.far")
    near, far = np.array(bounds).T
    return float(near.min()), float(far.max())
