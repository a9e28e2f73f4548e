"""Cameras in a ``transforms.json``: every key is read, refused, or known to change nothing."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

import numpy as np

from ctm_plugin.data.readers.lens import CROP_RATIOS, Intrinsics
from ctm_plugin.data.readers.records import Record, read_record
from ctm_plugin.errors import DataError
from ctm_plugin.scene.poses import MAX_COORDINATE, check_pose, is_field_of_view
from ctm_plugin.settings.setting import Number

PINHOLE_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
"""Values of ``camera_model`` that are pinholes with OpenCV's distortion."""
MAX_PIXEL = 1e6
"""Largest focal length and coordinate in pixels."""
FOCAL_TOLERANCE = 0.02
"""Largest relative difference between a focal length and the one that a field of view implies."""
NARROW_VIEW, MAX_VIEW = math.radians(5), math.radians(170)
"""Fields of view in radians: below the first there is a warning, above the second no pinhole is possible."""
FAR_PRINCIPAL, MAX_PRINCIPAL = 0.25, 1.5
"""Distance of the principal point from the middle, in sides, from which there is a warning, and an error."""
SCALE_TOLERANCE = 0.2
"""Largest relative difference of the two scales that a principal point near the middle implies."""
SIZE_KEYS = ("w", "h")
LENS_KEYS = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "p1", "p2", "camera_angle_y", "camera_model")
"""Keys that describe a lens by more than ``camera_angle_x``."""
MASK_KEY = "mask_path"
NO_FISHEYE = f"no fisheye lens but one of {', '.join(PINHOLE_MODELS)}"
BY_NAME = "fl_x, fl_y, cx, cy and k1, k2, k3, p1, p2, a number each"
ONE_POSE = "one pose a picture, transform_matrix, as nerfstudio and instant-ngp write it by default"
REFUSED_KEYS = {
    **dict.fromkeys(("is_fisheye", "k4", "k5", "k6", "fisheye_crop_radius", "latlong", "equirectangular"), NO_FISHEYE),
    **dict.fromkeys(("ftheta_p0", "ftheta_p1", "ftheta_p2", "ftheta_p3", "ftheta_p4"), NO_FISHEYE),
    **dict.fromkeys(("distortion_params", "intrinsics", "intrinsic_matrix", "camera_matrix", "K", "focal"), BY_NAME),
    **dict.fromkeys(("x_fov", "y_fov", "fov"), "camera_angle_x and camera_angle_y, in radians"),
    **dict.fromkeys(("rolling_shutter", "transform_matrix_start", "transform_matrix_end"), ONE_POSE),
    **dict.fromkeys(("from_mitsuba", "from_na"), ONE_POSE),
}  # fmt: skip
"""Keys that change a camera's rays in an unknown way, with what is expected: refused unless they are 0, false or
null."""
FRAME_KEYS = ("file_path", MASK_KEY, "transform_matrix")
FILE_KEYS = ("frames", "near", "far", "train_filenames", "val_filenames", "test_filenames", "ply_file_path")
IGNORED_KEYS = (
    # Of nerfstudio: how its poses came about, what it does with them later, and depth, which is not read.
    "applied_transform", "applied_scale", "orientation_override", "auto_scale_poses_override", "colmap_im_id",
    "depth_file_path", "depth_unit_scale_factor",
    # Of instant-ngp: its own box, into which all is moved and scaled, and scores of its pictures.
    "aabb_scale", "aabb", "render_aabb", "scale", "offset", "up", "sharpness", "n_frames", "integer_depth_scale",
    "enable_depth_loading", "sharpness_discard_threshold", "n_extra_learnable_dims",
    # Of Synthetic-NeRF and of our renderer.
    "rotation", "depth_scale",
)  # fmt: skip
"""Keys of known tools that do not concern the cameras, or tell what has been applied already."""


def has_value(owner: Record, key: str) -> bool:
    """Tell whether a key has a value that matters: not missing, 0, false, null, or a list of these."""
    value = owner.values.get(key)
    return any(value) if isinstance(value, list) else bool(value)


def angle_alone(path: Path) -> bool:
    """Tell whether a file gives its cameras only by ``camera_angle_x``, as Synthetic-NeRF's do, or is broken."""
    with suppress(DataError):
        return _angle_alone(read_record(path))
    return True


@lru_cache(maxsize=4)
def _angle_alone(record: Record) -> bool:
    owners = [record, *(frames_of(record) if record.values.get("frames") else ())]
    return not any(has_value(owner, key) for owner in owners for key in (*LENS_KEYS, *REFUSED_KEYS, MASK_KEY))


def check_keys(owners: Iterable[Record]) -> None:
    """Refuse unsupported keys, and warn once of unknown ones, in files, each followed by its frames."""
    owners = list(owners)
    masked = any(has_value(owner, MASK_KEY) for owner in owners)
    known = {*SIZE_KEYS, *LENS_KEYS, *REFUSED_KEYS, *FRAME_KEYS, *FILE_KEYS, *IGNORED_KEYS, "camera_angle_x"}
    unknown: dict[str, Path] = {}
    for owner in owners:
        for key in owner.values:
            if key in REFUSED_KEYS and has_value(owner, key):
                raise owner.fault(key, REFUSED_KEYS[key])
            if (
                "mask" in key
                and key not in known
                and has_value(owner, key)
                and not (masked and owner.values[key] is True)
            ):
                raise owner.fault(key, "masks under mask_path, whose bright pixels count, or no such key")
            if key not in known and not ("mask" in key and isinstance(owner.values[key], bool)):
                unknown.setdefault(key, owner.source)
    if unknown:
        shown = ", ".join(repr(key) for key in list(unknown)[:10])
        source = next(iter(unknown.values()))
        warnings.warn(f"{source}: what {shown} say is not known here and not used", stacklevel=2)


def frames_of(record: Record) -> list[Record]:
    """List the frames of a file."""
    return record.records("frames", "a list of frames, each with file_path and transform_matrix")


def read_pose(frame: Record) -> np.ndarray:
    """Read a frame's camera to world, ``[3, 4]``; in the file its last row ``0 0 0 1`` may be left out."""
    given = frame.values.get("transform_matrix")
    whole = not (isinstance(given, list) and len(given) == 3)
    pose = frame.matrix("transform_matrix", 3 + whole, 4, MAX_COORDINATE)
    pose = pose if whole else np.append(pose, [[0.0, 0.0, 0.0, 1.0]], axis=0)
    check_pose(pose, frame.source, frame.place("transform_matrix"))
    return pose[:3]


def read_camera(record: Record, frame: Record, width: int, height: int, remarks: dict[str, str]) -> Intrinsics:
    """Read a frame's intrinsics: each number from the frame, else from the file, else from the picture.

    ``remarks`` collects warnings about the cameras, one for each key. DataError: no focal length, a lens that is
    no pinhole with distortion, or numbers of another picture.
    """

    def given(key: str) -> Record | None:
        return frame if key in frame else record if key in record else None

    def number(key: str, usual: float, allowed: Callable[[Number], bool], expected: str) -> float:
        owner = given(key)
        return usual if owner is None else owner.number(key, allowed, expected)

    if (owner := given("camera_model")) and owner.values["camera_model"] not in PINHOLE_MODELS:
        raise owner.fault("camera_model", f"one of {', '.join(PINHOLE_MODELS)}: undistort the pictures of others first")
    pixels = "a number of pixels > 0"
    width = number("w", float(width), is_length, pixels)
    height = number("h", float(height), is_length, pixels)

    def focal(axis: str, side: float) -> tuple[float | None, float | None]:
        """Focal lengths in pixels by ``fl_<axis>`` and by the field of view; a frame's value goes before the file's."""
        owner, other = given(f"fl_{axis}"), given(f"camera_angle_{axis}")
        if owner and other and owner is not other:
            owner, other = (owner, None) if owner is frame else (None, other)
        length = owner.number(f"fl_{axis}", is_length, pixels) if owner else None
        expected = "the field of view in radians, in (0, pi)"
        angle = other.number(f"camera_angle_{axis}", is_field_of_view, expected) if other else None
        return length, None if angle is None else 0.5 / math.tan(0.5 * angle) * side

    (fx, across), (fy, down) = focal("x", width), focal("y", height)
    if differ(fx, across):
        expected = f"what belongs to fl_x = {fx:g}: it is {across:g} pixels of {width:g}; one of both is wrong"
        raise given("camera_angle_x").fault("camera_angle_x", expected)
    if differ(fy, down):
        expected = f"what belongs to fl_y = {fy:g}: it is {down:g} pixels of {height:g}; one of both is wrong"
        wrong = given("camera_angle_y").fault("camera_angle_y", expected)
        if None in (fx, across) or differ(fx, fy):
            raise wrong
        # BlenderNeRF takes it from the sensor's height, whatever the picture's.
        remarks.setdefault("camera_angle_y", "camera_angle_y is ignored: fl_x, fl_y and camera_angle_x contradict it")
    fx, fy = across if fx is None else fx, down if fy is None else fy
    if fx is None:
        raise record.fault("fl_x", "the focal length in pixels, or camera_angle_x")

    def any_number(key: str, usual: float = 0.0) -> float:
        return number(key, usual, lambda v: -MAX_PIXEL <= v <= MAX_PIXEL, "a number")

    centre = any_number("cx", 0.5 * width), any_number("cy", 0.5 * height)
    lens = tuple(map(any_number, ("k1", "k2", "p1", "p2", "k3")))
    camera = Intrinsics(width, height, fx, fx if fy is None else fy, *centre, lens, where=frame.where)
    check_view(camera, record.source, bool(given("w") and given("h")), remarks)
    return camera


def differ(length: float | None, other: float | None) -> bool:
    """Tell whether two focal lengths are both given and differ by more than ``FOCAL_TOLERANCE``."""
    return length is not None and other is not None and abs(other / length - 1) > FOCAL_TOLERANCE


def check_view(camera: Intrinsics, source: Path, sized: bool, remarks: dict[str, str]) -> None:
    """Refuse intrinsics that do not fit a picture of the camera's size, and remark on unusual ones.

    ``sized`` is whether the file gives the camera's size; else the picture's size is taken.
    """
    width, height, cx, cy = camera.width, camera.height, camera.cx, camera.cy
    found = f"{camera.where} with fl_x {camera.fx:g}, fl_y {camera.fy:g}, cx {cx:g}, cy {cy:g} for {width:g}x{height:g}"
    larger, parts = (2 * cx / width, 2 * cy / height), 0 < cx < 1 and 0 < cy < 1
    other = min(larger) > CROP_RATIOS[1] or max(larger) < CROP_RATIOS[0]
    if other and not (sized or parts) and abs(larger[0] - larger[1]) < SCALE_TOLERANCE * larger[0]:
        expected = f"w and h of the pictures that these numbers are of, about {2 * cx:g}x{2 * cy:g}"
        raise DataError(source, found, expected)
    views = [
        math.atan(start / focal) + math.atan((side - start) / focal)
        for start, side, focal in ((cx, width, camera.fx), (cy, height, camera.fy))
    ]
    off = max(abs(cx / width - 0.5), abs(cy / height - 0.5))
    if parts or max(views) > MAX_VIEW or off > MAX_PRINCIPAL:
        expected = "pixels of a picture of this size: parts of the sides are to be multiplied by w and h, and numbers "
        raise DataError(source, found, expected + "of another size go with its w and h")
    if off > FAR_PRINCIPAL:
        remarks.setdefault("cx", f"the principal point is far from the picture's middle: {found}, in pixels")
    if max(views) < NARROW_VIEW:
        angle = math.degrees(max(views))
        remarks.setdefault("fl_x", f"a field of view of {angle:.2g} degrees: {found}, in pixels")


def is_length(value: Number) -> bool:
    """Whether a number of pixels can be a side or a focal length."""
    return 1e-3 <= value <= MAX_PIXEL
