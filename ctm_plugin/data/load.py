"""Loading of a data set's folder as a scene: cameras, pictures, geometry, near and far."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch

from ctm_plugin.data.capture import Capture
from ctm_plugin.data.lit_references import warn_of_lit
from ctm_plugin.data.near_far import near_far, nearest
from ctm_plugin.data.points import first_points
from ctm_plugin.data.readers.records import rendered
from ctm_plugin.data.rig import Rig, rig_of
from ctm_plugin.data.settings import PhotoConfig
from ctm_plugin.data.to_views import develop_photographs
from ctm_plugin.errors import ConfigError
from ctm_plugin.scene.frustum import edge_rays
from ctm_plugin.scene.kinds import AUTO
from ctm_plugin.scene.poses import Similarity, mean_pose, meeting_depths
from ctm_plugin.scene.views import Points, Scene, Views

NEAR_TARGET = 0.75
"""The nearest bound is scaled to a distance of 1 / 0.75, so that NDC's near plane, at 1, lies in front of all."""
OPENCV_TO_OPENGL = np.array([1.0, -1.0, -1.0, 1.0])
"""Signs that take OpenCV's axes (y down, z forward) to OpenGL's."""


class Layout:
    """Mixin for a data set's settings: loads the scene of a folder whose layout's files ``capture`` reads."""

    layout: ClassVar[str]

    def capture(self) -> Capture:
        """Read the cameras and the list of pictures out of the folder's files, without decoding pixels.

        Raises:
            DataError, ConfigError: see :meth:`load`.
        """
        raise NotImplementedError

    def rig(self, capture: Capture | None = None) -> Rig:
        """Arrangement of the data set's cameras, without the pixels; the ``capture`` is read unless it is given."""
        capture = capture or self.capture()
        first = next(each.picture.header for each in capture.photographs if each.picture)
        size = first[:2] if capture.shrunk else self.shrunk(first.height, first.width)
        cameras = {each.camera for each in capture.photographs}
        alone = capture.synthetic or first.alpha
        return rig_of(cameras, list(capture.c2w), size, alone, nearest(capture, self))

    def load(self, capture: Capture | None = None) -> Scene:
        """Load the data set as a scene; its ``capture`` is read unless it is given.

        Returns:
            The scene, named as its folder, in units of the files' poses unless ``geometry`` is forward.

        Raises:
            DataError: a file is missing or cannot be used; the message names it.
            ConfigError: ``downscale`` or ``width`` do not suit the size, ``random_matched`` lacks alpha, or the cameras
                do not face forward as ``geometry`` says.
        """
        capture = capture or self.capture()
        geometry = self.rig(capture).geometry()[0] if self.geometry == AUTO else self.geometry
        config = replace(self, geometry=geometry)
        train, test = develop_photographs(capture, config)
        if not capture.synthetic and test.lit is None and getattr(self, "dark", None) is None:
            warn_of_lit(capture, train, test)
        near, far = near_far(capture, config, (train, test))
        trained = [capture.photographs[i].name for i in config.trained_on(capture.testing)]
        points = first_points(trained, *capture.clouds)
        return make_scene(capture.root, config, train, test, near, far, points)


def make_scene(
    root: Path, config: PhotoConfig, train: Views, test: Views, near: float, far: float, points: Points | None = None
) -> Scene:
    """Make the scene of a folder, named like it, settled; its exposure includes the light that it was rendered under.

    One warning tells if all cameras look away from where their axes meet, as with wrong axis conventions.
    """
    c2w = torch.cat([train.c2w, test.c2w]).double().numpy()
    if config.geometry != "forward" and meeting_depths(c2w * OPENCV_TO_OPENGL) is not None:
        reason = "the cameras' axes meet behind all cameras: they look outwards, or have OpenCV's axes"
        warnings.warn(
            f"{root}: {reason}, of which y and z (columns 2 and 3 of camera to world) are to be flipped", stacklevel=3
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
        exposure=config.exposure * rendered(root, "light"),
        points=points,
    )
    return to_ndc_frame(scene, root)


def to_ndc_frame(scene: Scene, root: Path) -> Scene:
    """Move and scale a ``forward`` scene as NDC needs it, NeRF's way; others stay as they are.

    The world is moved so that the mean camera stands at the origin and looks along -z, and scaled so that ``near`` lies
    at ``1 / 0.75``; the scene's near is then NDC's near plane, 1.

    Raises:
        ConfigError: not all rays go the same way from in front of the near plane, or near is 0.
    """
    if scene.geometry != "forward":
        return scene
    views = (scene.train, scene.test)
    if not scene.near > 0:
        raise ConfigError("dataset.near", scene.near, f"more than 0 for dataset.geometry=forward of {root}")
    scale = 1.0 / (NEAR_TARGET * scene.near)
    given = torch.cat([split.c2w for split in views]).double().numpy()
    mean = mean_pose(given)
    world = Similarity(scale, mean[:, :3].T, -scale * mean[:, :3].T @ mean[:, 3], off=0.0, angle=0.0)
    poses = torch.from_numpy(world.of_poses(given)).to(torch.float32).split([len(split) for split in views])
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
