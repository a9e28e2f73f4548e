"""Scenes of the geometry that the configuration asks for: the world moved for NDC."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ctm_plugin.data.readers.renderings import read_light
from ctm_plugin.data.settings import PhotoConfig
from ctm_plugin.errors import ConfigError
from ctm_plugin.scene.frustum import edge_rays
from ctm_plugin.scene.poses import Similarity, mean_pose, meeting_depths, recentre
from ctm_plugin.scene.views import Points, Scene, Views

NEAREST = 0.75
"""The nearest bound is brought to a distance of 1 / 0.75, so that NDC's near plane, at 1, lies in front of all."""
FLIPPED = np.array([1.0, -1.0, -1.0, 1.0])
"""Takes OpenCV's axes, y down and z forward, to OpenGL's."""


def make_scene(
    root: Path, config: PhotoConfig, train: Views, test: Views, near: float, far: float, points: Points | None = None
) -> Scene:
    """The scene of a folder, named as it, and settled; its exposure counts the light that it was rendered under.

    One warning tells of cameras that all look away from where their axes meet, as with another program's axes.

    Raises:
        ConfigError: see :func:`settle`.
    """
    c2w = torch.cat([train.c2w, test.c2w]).double().numpy()
    if config.geometry != "forward" and meeting_depths(c2w * FLIPPED) is not None:
        told = "the cameras' axes meet behind all cameras: they look outwards, or have OpenCV's axes"
        warnings.warn(
            f"{root}: {told}, of which y and z (columns 2 and 3 of camera to world) are to be flipped", stacklevel=3
        )
    if train.has_alpha and not train.images[..., 3].any():
        warnings.warn(f"{root}: no training picture shows anything, their alpha is 0 everywhere", stacklevel=3)
    scene = Scene(
        name=root.resolve().name,
        train=train,
        test=test,
        near=near,
        far=far,
        geometry=config.geometry,
        background=config.background,
        background_level=config.background_level,
        exposure=config.exposure * read_light(root),
        points=points,
    )
    return settle(scene, root)


def settle(scene: Scene, root: Path) -> Scene:
    """A ``forward`` scene as NDC needs it, NeRF's way; others as they are.

    The world is moved so that the mean camera stands at the origin and looks along -z, and scaled so that ``near`` lies
    at ``1 / 0.75``; the scene's near is then NDC's near plane, 1.

    Args:
        scene: as its files have it.
        root: of those, for messages.

    Raises:
        ConfigError: not all rays go the same way from in front of the near plane, or near is 0.
    """
    if scene.geometry != "forward":
        return scene
    views = (scene.train, scene.test)
    if not scene.near > 0:
        raise ConfigError("dataset.near", scene.near, f"more than 0 for dataset.geometry=forward of {root}")
    scale = 1.0 / (NEAREST * scene.near)
    given = torch.cat([split.c2w for split in views]).double().numpy()
    mean = mean_pose(given)
    c2w = recentre(given)
    c2w[:, :, 3] *= scale
    world = Similarity(scale, mean[:, :3].T, -scale * mean[:, :3].T @ mean[:, 3], off=0.0, angle=0.0)
    poses = torch.from_numpy(c2w).to(torch.float32).split([len(split) for split in views])
    train, test = (
        replace(split, c2w=moved, depth=None if split.depth is None else split.depth * scale)
        for split, moved in zip(views, poses, strict=True)
    )
    if not (faces_forward(train) and faces_forward(test)):
        expected = f"bounded or unbounded: not all rays of {root} start in front of near and go the same way"
        raise ConfigError("dataset.geometry", scene.geometry, expected)
    points = scene.points
    if points is not None:
        positions = torch.from_numpy(world.moved(points.positions.double().numpy())).to(torch.float32)
        points = replace(points, positions=positions)
    far = float(scene.far * scale)
    return replace(scene, train=train, test=test, near=1.0, far=far, world=world, points=points)


def faces_forward(views: Views) -> bool:
    """Whether all rays start in front of NDC's near plane, at z = -1, and go towards it; not where numbers are NaN."""
    rays = edge_rays(views)
    return bool((rays.origins[:, 2] > -1).all() and (rays.directions[:, 2] < 0).all())
