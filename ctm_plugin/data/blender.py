"""The layout of Synthetic-NeRF: ``transforms_{train,test}.json`` and RGBA pictures; also what our renderer writes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from ctm_plugin.data.config import BoundsConfig, check_matched_background, settled
from ctm_plugin.data.develop import common_size, develop, develop_depth
from ctm_plugin.data.geometry import given_bounds, make_scene
from ctm_plugin.data.readers.folders import find_image, inside, view_names
from ctm_plugin.data.readers.images import PICTURES
from ctm_plugin.data.readers.layouts import TEST, TRAIN, beyond_angle, open_layout
from ctm_plugin.data.readers.lens import Camera
from ctm_plugin.data.readers.records import Record, read_record
from ctm_plugin.data.rig import Rig, rig_of
from ctm_plugin.scene.poses import MAX_COORDINATE, check_pose, intrinsics_from_angle, is_field_of_view
from ctm_plugin.scene.views import Scene, Views
from ctm_plugin.settings.build import REQUIRED, setting
from ctm_plugin.settings.check import Number

NEAR, FAR = 2.0, 6.0
"""Synthetic-NeRF's bounds, for files that do not give their own."""
FRAMES = "a list of frames, each with file_path and transform_matrix"


@dataclass(frozen=True, kw_only=True)
class BlenderConfig(BoundsConfig):
    """Synthetic-NeRF's layout: transforms_train.json, transforms_test.json, RGBA pictures."""

    root: str | Path = setting(REQUIRED, "folder with the two JSON files")
    near: Number | None = setting(BoundsConfig.near, "bounds along the rays; null: the file's own, else 2 and 6")

    def rig(self) -> Rig:
        record = read_record(inside(open_layout(self.root, "blender", self.links), TRAIN))
        angle, poses = read_cameras(record)
        name = record.records("frames", FRAMES)[0].text("file_path", "the image's path")
        height, width, *_ = PICTURES.header(find_image(record.source.parent, name, record.source))
        camera = Camera(width, height, *intrinsics_from_angle(angle, height, width))
        return rig_of([camera], list(poses[:, :3]), self.shrunk(height, width), alone=True)

    def load(self) -> Scene:
        """Read a data set in Blender layout.

        Pictures are shrunk with premultiplied alpha, dimmed, training views given noise, and rounded to 8 bits. Test
        views have depth where ``transforms_test.json`` holds ``depth_scale`` and every frame a ``depth_file_path``:
        16-bit grey, ``depth = code x depth_scale`` along the ray, code 0 for nothing.

        Returns:
            The scene, named as its folder. Its exposure is ``exposure`` times the ``light`` in the ``settings.json``
            of our renderer, where there is one.

        Raises:
            DataError: a file is missing or cannot be used, or gives its cameras by more than ``camera_angle_x``; the
                message names it.
            ConfigError: ``downscale`` or ``width`` do not suit the size, ``random_matched`` lacks alpha, or the cameras
                do not face forward as ``geometry`` says.
        """
        self = settled(self)
        root = open_layout(self.root, "blender", self.links)
        train_file, test_file = (read_record(inside(root, name)) for name in (TRAIN, TEST))
        for record in (train_file, test_file):
            if more := beyond_angle(record):
                raise more[0].fault(
                    more[1], "camera_angle_x alone in this layout: dataset=transforms reads what else is there"
                )
        train = read_split(root, train_file, self, training=True)
        near, far = given_bounds(self, [train_file], lambda: (NEAR, FAR), train_file.source)
        check_matched_background(self, train, root)
        return make_scene(root, self, train, read_split(root, test_file, self, training=False), near, far)


def read_split(root: Path, record: Record, config: BlenderConfig, training: bool) -> Views:
    """The views of one ``transforms_*.json``.

    Args:
        root: the data set's folder.
        record: the file's content.
        config: how to read it.
        training: training views are thinned by ``skip`` and given noise; test views have depth.
    """
    angle, poses = read_cameras(record)
    frames = record.records("frames", FRAMES)
    paths = [find_image(root, frame.text("file_path", "the image's path"), record.source) for frame in frames]

    keep = slice(None, None, config.skip if training else 1)
    paths, names, poses = paths[keep], view_names(paths)[keep], poses[keep, :3]
    images = develop(paths, names, config, noisy=training)
    height, width = images.shape[1:3]
    taken = common_size(paths)
    camera = Camera(taken.width, taken.height, *intrinsics_from_angle(angle, taken.height, taken.width))
    return Views(
        images=images,
        c2w=torch.from_numpy(poses).to(torch.float32),
        intrinsics=torch.tensor(camera.scaled(width, height).pinhole).repeat(len(names), 1),
        names=names,
        depth=None if training else read_depths(root, record, height, width),
    )


def read_cameras(record: Record) -> tuple[float, Float64[np.ndarray, "n 4 4"]]:
    """The horizontal field of view in radians and the poses, camera to world, of a ``transforms_*.json``.

    Raises:
        DataError: one is missing or cannot be used.
    """
    angle = record.number("camera_angle_x", is_field_of_view, "the field of view in radians, in (0, pi)")
    poses = []
    for frame in record.records("frames", FRAMES):
        pose = frame.matrix("transform_matrix", 4, 4, MAX_COORDINATE)
        check_pose(pose, record.source, frame.place("transform_matrix"))
        poses.append(pose)
    return angle, np.stack(poses)


def read_depths(root: Path, record: Record, height: int, width: int) -> Float32[Tensor, "n {height} {width}"] | None:
    """The depth pictures that the file lists; ``None`` without ``depth_scale``, which tells what they mean."""
    if "depth_scale" not in record:
        return None
    scale = record.number("depth_scale", lambda v: 0 < v <= MAX_COORDINATE, "scene units a step, a number > 0")
    frames = record.records("frames", "a list of frames")
    names = [frame.text("depth_file_path", "the depth picture's path") for frame in frames]
    return develop_depth([find_image(root, name, record.source) for name in names], scale, height, width)
