"""The layout of Synthetic-NeRF: ``transforms_{train,test}.json`` and RGBA pictures; also what our renderer writes."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from ctm_plugin.data.bounds import bounds_of_cameras
from ctm_plugin.data.config import BoundsConfig, check_matched_background, settled
from ctm_plugin.data.develop import common_size, develop, develop_depth
from ctm_plugin.data.geometry import given_bounds, make_scene
from ctm_plugin.data.readers.folders import find_image, inside, look_for, view_names
from ctm_plugin.data.readers.frames import check_keys
from ctm_plugin.data.readers.images import PICTURES
from ctm_plugin.data.readers.layouts import TEST, TRAIN, beyond_angle, open_layout
from ctm_plugin.data.readers.lens import Camera
from ctm_plugin.data.readers.records import Record, read_record
from ctm_plugin.data.rig import Rig, rig_of
from ctm_plugin.errors import DataError
from ctm_plugin.scene.poses import (
    MAX_COORDINATE,
    check_pose,
    intrinsics_from_angle,
    is_field_of_view,
    meeting_depths,
)
from ctm_plugin.scene.views import Geometry, Scene, Views
from ctm_plugin.settings.build import REQUIRED, setting
from ctm_plugin.settings.check import Number

NEAR, FAR = 2.0, 6.0
"""Synthetic-NeRF's bounds, for files that do not give their own."""
RADIUS = 1.0
"""What these bounds have to hold on both sides of where the cameras' axes meet."""
FRAMES = "a list of frames, each with file_path and transform_matrix"


@dataclass(frozen=True, kw_only=True)
class BlenderConfig(BoundsConfig):
    """Synthetic-NeRF's layout: transforms_train.json, transforms_test.json, RGBA pictures."""

    root: str | Path = setting(REQUIRED, "folder with transforms_train.json and transforms_test.json")
    near: Number | None = setting(
        BoundsConfig.near, "distance at which rays begin; null: the file's, else 2 (and far 6), or from the cameras"
    )

    def rig(self) -> Rig:
        record = read_record(inside(open_layout(self.root, "blender", self.links), TRAIN))
        angle, poses = read_cameras(record)
        name = record.records("frames", FRAMES)[0].text("file_path", "the image's path")
        height, width, *_ = PICTURES.header(find_image(record.source.parent, name, record.source))
        camera = Camera(width, height, *intrinsics_from_angle(angle, height, width))
        return rig_of([camera], list(poses[:, :3]), self.shrunk(height, width), alone=True)

    def load(self) -> Scene:
        """Read a data set in Blender layout.

        Files that give more of their cameras than ``camera_angle_x`` are refused: ``dataset=transforms`` reads them.
        Near and far of 2 and 6 give way, with a warning, to bounds from the cameras where they do not suit these.

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
                    more[1], "only camera_angle_x in this layout: dataset=transforms reads the other keys"
                )
        check_keys(owner for file in (train_file, test_file) for owner in (file, *file.records("frames", FRAMES)))
        train = read_split(root, train_file, self, training=True)

        def bound() -> tuple[float, float]:
            poses = np.concatenate([read_cameras(file)[1] for file in (train_file, test_file)])
            return usual_bounds(train_file.source, poses[:, :3], self.geometry)

        near, far = given_bounds(self, [train_file], bound, train_file.source)
        check_matched_background(self, train, root)
        return make_scene(root, self, train, read_split(root, test_file, self, training=False), near, far)


def usual_bounds(source: Path, c2w: Float64[np.ndarray, "n 3 4"], geometry: Geometry) -> tuple[float, float]:
    """Synthetic-NeRF's near and far where they suit the cameras, else such as do; a warning tells of doubts.

    They suit where a ball of ``RADIUS`` round the point where the axes meet lies between them in all cameras.
    """
    depths = meeting_depths(c2w)
    if depths is None:
        told = f"near {NEAR:g} and far {FAR:g} are Synthetic-NeRF's, and the cameras do not look at one point"
        warnings.warn(f"{source}: {told}: dataset.near and dataset.far set them", stacklevel=2)
    elif depths.min() < NEAR + RADIUS or depths.max() > FAR - RADIUS:
        middle = float(np.median(depths))
        missing = f"near {NEAR:g} and far {FAR:g} do not suit cameras {middle:.3g} away from where they look"
        return bounds_of_cameras(source, c2w, geometry, missing)
    return NEAR, FAR


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
    names = [frame.text("file_path", "the image's path") for frame in frames]
    paths = [look_for(root, name, record.source) for name in names]
    if missing := [name for name, path in zip(names, paths, strict=True) if path is None]:
        found = f"{len(missing)} of {len(names)} pictures missing, such as {missing[0]!r}"
        raise DataError(
            record.source,
            found,
            "all; dataset=transforms leaves training pictures out, and renders test views that have none",
        )

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
