"""One ``transforms.json`` with full intrinsics and lens distortion, as instant-ngp and nerfstudio write it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from ctm_plugin.data.config import BoundsConfig, CaptureConfig
from ctm_plugin.data.develop import common_size
from ctm_plugin.data.geometry import given_bounds, make_scene
from ctm_plugin.data.photographs import (
    Photograph,
    Pictures,
    develop_photographs,
    every,
    existing,
    find_listed,
    has_shrunk,
)
from ctm_plugin.data.readers.folders import own, require_folder
from ctm_plugin.data.readers.lens import Camera
from ctm_plugin.data.readers.records import Record, read_record
from ctm_plugin.errors import DataError
from ctm_plugin.scene.poses import MAX_COORDINATE, check_pose, intrinsics_from_angle, is_field_of_view
from ctm_plugin.scene.views import Scene
from ctm_plugin.settings.build import REQUIRED, setting
from ctm_plugin.settings.check import Number

TRANSFORMS = "transforms.json"
MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
"""Values of ``camera_model`` that are pinholes with OpenCV's distortion."""
MAX_PIXEL = 1e6
"""Largest focal length and coordinate in pixels."""


@dataclass(frozen=True, kw_only=True)
class TransformsConfig(CaptureConfig, BoundsConfig):
    """One transforms.json with full intrinsics and lens distortion, as instant-ngp and nerfstudio write it."""

    root: str | Path = setting(REQUIRED, "folder with transforms.json")
    test_every: int = setting(
        CaptureConfig.test_every, "each view with a number divisible by this is for testing, unless the file lists some"
    )

    def load(self) -> Scene:
        """See :func:`load_transforms`."""
        return load_transforms(self)


def load_transforms(config: TransformsConfig) -> Scene:
    """Read a data set with a ``transforms.json``.

    Frames whose picture is missing are left out, with one warning. Where a file is listed under ``images`` and there is
    a folder ``images_<downscale>``, the picture there is taken.

    Args:
        config: see :class:`TransformsConfig`.

    Returns:
        The scene, named as its folder, in units of the poses unless ``geometry`` is forward.

    Raises:
        DataError: a file is missing or cannot be used; the message names it.
        ConfigError: ``downscale`` or ``width`` do not suit the size, ``random_matched`` lacks alpha, or the cameras do
            not face forward as ``geometry`` says.
    """
    root = require_folder(config.root, f"a folder with {TRANSFORMS}")
    source = own(root, TRANSFORMS)
    record = read_record(source)
    frames = record.records("frames", "a list of frames, each with file_path and transform_matrix")
    frames = sorted(frames, key=frame_name)
    shrunk = has_shrunk(root, config.whole_factor)
    listed = [resized(frame_name(frame), config.whole_factor) if shrunk else frame_name(frame) for frame in frames]
    paths = [find_listed(root, name, source) for name in listed]
    training, testing = split(record, frames, existing(paths, listed, source), config.test_every)
    chosen = np.concatenate([training, testing])
    pictures = Pictures(root, shrunk)
    size = common_size([paths[i] for i in chosen])
    factor = config.whole_factor if shrunk else 1
    photographs = [
        Photograph(
            paths[i], read_pose(frames[i]), read_camera(record, frames[i], factor * size.width, factor * size.height)
        )
        for i in chosen
    ]
    poses = np.stack([photograph.c2w for photograph in photographs])
    near, far = given_bounds(config, record, poses)
    train, test = develop_photographs(photographs, np.arange(len(chosen)) >= len(training), pictures, config, source)
    return make_scene(root, config, train, test, near, far)


def frame_name(frame: Record) -> str:
    """The picture's path as the file gives it, without ``./``."""
    return str(PurePosixPath(frame.text("file_path", "the picture's path")))


def resized(name: str, downscale: int) -> str:
    """``images_4/a.png`` for ``images/a.png`` and 4; others unchanged."""
    first, *rest = PurePosixPath(name).parts
    return str(PurePosixPath(f"images_{downscale}", *rest)) if first == "images" and rest else name


def split(record: Record, frames: list[Record], there: list[int], test_every: int) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of the frames to train on and of those for testing, out of those whose pictures are there.

    ``test_filenames``, else ``val_filenames`` are for testing, and ``train_filenames``, else all others for training;
    without a list for testing, every ``test_every``-th of the frames is.

    Raises:
        DataError: none are left for one of the two.
    """
    numbers = np.array(there, dtype=np.int64)
    names = [frame_name(frames[i]) for i in there]

    def among(key: str) -> np.ndarray:
        listed = {str(PurePosixPath(name)) for name in record.texts(key, "a list of the frames' file_path")}
        return np.array([name in listed for name in names], dtype=bool)

    keys = [key for key in ("test_filenames", "val_filenames") if record.values.get(key)]
    testing = among(keys[0]) if keys else every(test_every, len(there))
    training = ~testing & among("train_filenames") if keys and record.values.get("train_filenames") else ~testing
    if not (training.any() and testing.any()):
        found = f"{training.sum()} frames for training and {testing.sum()} for testing whose pictures are there"
        raise DataError(record.source, found, "at least one for each: see train_filenames and test_filenames")
    return numbers[training], numbers[testing]


def read_pose(frame: Record) -> np.ndarray:
    """``[3, 4]`` camera to world.

    Raises:
        DataError: it is missing or no pose.
    """
    pose = frame.matrix("transform_matrix", 4, 4, MAX_COORDINATE)
    check_pose(pose, frame.source, frame.place("transform_matrix"))
    return pose[:3]


def read_camera(record: Record, frame: Record, width: int, height: int) -> Camera:
    """The camera of one frame: each of its numbers the frame's own, else the file's.

    Args:
        record, frame: the file and one of its frames.
        width, height: of the pictures, as large as they were taken; what the file says goes before.

    Raises:
        DataError: a number cannot be used, the focal length is missing, or the model is another.
    """

    def given(key: str) -> Record | None:
        return frame if key in frame else record if key in record else None

    def number(key: str, usual: float, allowed: Callable[[Number], bool], expected: str) -> float:
        owner = given(key)
        return usual if owner is None else owner.number(key, allowed, expected)

    if (owner := given("camera_model")) and owner.values["camera_model"] not in MODELS:
        raise owner.fault("camera_model", f"one of {', '.join(MODELS)}")
    for key in ("is_fisheye", "k4"):
        if (owner := given(key)) and owner.values[key]:
            raise owner.fault(key, f"no fisheye lens but one of {', '.join(MODELS)}")

    pixels = "a number of pixels > 0"
    width = number("w", float(width), is_length, pixels)
    height = number("h", float(height), is_length, pixels)
    angle = "the field of view in radians, in (0, pi)"
    if owner := given("fl_x"):
        fx = owner.number("fl_x", is_length, pixels)
    elif owner := given("camera_angle_x"):
        fx = intrinsics_from_angle(owner.number("camera_angle_x", is_field_of_view, angle), 1, 1)[0] * width
    else:
        raise record.fault("fl_x", "the focal length in pixels, or camera_angle_x")
    fy = fx
    if given("fl_y") is None and (owner := given("camera_angle_y")):
        fy = intrinsics_from_angle(owner.number("camera_angle_y", is_field_of_view, angle), 1, 1)[0] * height
    return Camera(
        width,
        height,
        fx,
        number("fl_y", fy, is_length, pixels),
        number("cx", 0.5 * width, lambda v: -MAX_PIXEL <= v <= MAX_PIXEL, "a number of pixels"),
        number("cy", 0.5 * height, lambda v: -MAX_PIXEL <= v <= MAX_PIXEL, "a number of pixels"),
        tuple(
            number(key, 0.0, lambda v: -MAX_PIXEL <= v <= MAX_PIXEL, "a number")
            for key in ("k1", "k2", "p1", "p2", "k3")
        ),
        where=frame.where,
    )


def is_length(value: Number) -> bool:
    """Whether a number of pixels can be a side or a focal length."""
    return 1e-3 <= value <= MAX_PIXEL
