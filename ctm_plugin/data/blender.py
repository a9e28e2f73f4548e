"""The layout of Synthetic-NeRF: ``transforms_{train,test}.json`` and RGBA pictures; also what our renderer writes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from ctm_plugin.data.capture import Capture, Photograph
from ctm_plugin.data.load import Layout
from ctm_plugin.data.readers.folders import find_image, inside, look_for
from ctm_plugin.data.readers.frames import beyond_angle, check_keys, frames_of, read_pose
from ctm_plugin.data.readers.images import read_picture
from ctm_plugin.data.readers.layouts import TEST, TRAIN, open_layout
from ctm_plugin.data.readers.lens import Camera
from ctm_plugin.data.readers.records import Record, read_record
from ctm_plugin.data.settings import BlenderSettings
from ctm_plugin.errors import DataError
from ctm_plugin.scene.poses import MAX_COORDINATE, intrinsics_from_angle, is_field_of_view


class BlenderConfig(Layout, BlenderSettings):
    layout = "blender"

    def capture(self) -> Capture:
        """Read a data set in Blender layout.

        Files that give more of their cameras than ``camera_angle_x`` are refused: ``dataset=transforms`` reads them.
        Near and far of 2 and 6 give way, with a warning, to bounds from the cameras where they do not suit these.

        Pictures are shrunk with premultiplied alpha, dimmed, training views given noise, and rounded to 8 bits. Test
        views have depth where ``transforms_test.json`` holds ``depth_scale`` and every frame a ``depth_file_path``:
        16-bit grey, ``depth = code x depth_scale`` along the ray, code 0 for nothing.

        The scene's exposure is ``exposure`` times the ``light`` in the ``settings.json`` of our renderer, where there
        is one.
        """
        root = open_layout(self.root, self.layout, self.links)
        train, test = files = [read_record(inside(root, name)) for name in (TRAIN, TEST)]
        for record in files:
            if more := beyond_angle(record):
                raise more[0].fault(
                    more[1], "only camera_angle_x in this layout: dataset=transforms reads the other keys"
                )
        check_keys(owner for record in files for owner in (record, *frames_of(record)))
        scale, depths = 1.0, [None] * len(frames_of(test))
        if "depth_scale" in test:
            expected = "scene units a step, a number > 0"
            scale = test.number("depth_scale", lambda value: 0 < value <= MAX_COORDINATE, expected)
            names = [frame.text("depth_file_path", "the depth picture's path") for frame in frames_of(test)]
            depths = [find_image(root, name, test.source) for name in names]
        trained = photographs(root, train, [None] * len(frames_of(train)))
        both = [*trained, *photographs(root, test, depths)]
        testing = np.arange(len(both)) >= len(trained)
        return Capture(root, train.source, both, testing, depth_scale=scale, records=[train], synthetic=True)


def photographs(root: Path, record: Record, depths: list[Path | None]) -> list[Photograph]:
    """The photographs of one ``transforms_*.json``, with their depth.

    Raises:
        DataError: one is missing, or a camera cannot be used.
    """
    angle, poses = read_cameras(record)
    names = [frame.text("file_path", "the image's path") for frame in frames_of(record)]
    paths = [look_for(root, name, record.source) for name in names]
    if missing := [name for name, path in zip(names, paths, strict=True) if path is None]:
        found = f"{len(missing)} of {len(names)} pictures missing, such as {missing[0]!r}"
        expected = "all; dataset=transforms leaves training pictures out, and renders test views that have none"
        raise DataError(record.source, found, expected)
    taken = []
    for path, name, pose, depth in zip(paths, names, poses, depths, strict=True):
        picture = read_picture(path)
        height, width = picture.header[:2]
        camera = Camera(width, height, *intrinsics_from_angle(angle, height, width))
        taken.append(Photograph(path, name, pose, camera, picture, depth=depth, shown=True))
    return taken


def read_cameras(record: Record) -> tuple[float, Float64[np.ndarray, "n 3 4"]]:
    """The horizontal field of view in radians and the poses, camera to world, of a ``transforms_*.json``.

    Raises:
        DataError: one is missing or cannot be used.
    """
    angle = record.number("camera_angle_x", is_field_of_view, "the field of view in radians, in (0, pi)")
    return angle, np.stack([read_pose(frame) for frame in frames_of(record)])
