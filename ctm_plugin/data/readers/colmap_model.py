"""COLMAP's model: ``cameras``, ``images`` and ``points3D``, binary or text, read with only numpy and scipy.

Text, which scripts write, is packed into the bytes of the binary files: both are read and checked in one place.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import struct
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

from ctm_plugin.data.readers.folders import read_bytes
from ctm_plugin.data.readers.lens import Intrinsics
from ctm_plugin.errors import DataError
from ctm_plugin.scene.poses import MAX_COORDINATE

MODEL_NAMES = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV",
    "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_DIVISION",
    "DIVISION", "SIMPLE_FISHEYE", "FISHEYE", "EUCM", "EQUIRECTANGULAR",
)  # fmt: skip
"""Names of COLMAP's camera models, at their numbers."""
MODEL_PARAMETERS = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "FULL_OPENCV": 12}
"""Number of parameters of each model that is a pinhole with OpenCV's distortion."""
UNDISTORT = "colmap image_undistorter makes pinholes of others"
MAX_SIDE = 2**20
"""Largest side in pixels that a camera may have."""
UPRIGHT_NOTE = "as_shown.txt"
"""Name of the file that marks a model of upright pictures, as ``ctm cameras`` makes it; COLMAP's own is of stored
pixels."""
NOT_A_NUMBER = re.compile(r"[+-]?(nan|inf|1\.#)", re.IGNORECASE)
"""Pattern of NaN and infinity in text, Windows' spellings included: ``-nan(ind)``, ``1.#QNAN``."""


def model_file(folder: Path, name: str) -> Path:
    """Find ``cameras``, ``images`` or ``points3D`` of a model: its text where there is no binary file."""
    binary, text = (folder / f"{name}{suffix}" for suffix in (".bin", ".txt"))
    return text if text.exists() and not binary.exists() else binary


def mark_as_shown(folder: Path, searched: Sequence[str]) -> None:
    """Mark a model as made of pictures as EXIF's orientation turns them, with the names of the pictures searched."""
    note = f"Cameras of the pictures as EXIF's orientation turns them. images.bin: sha256 {_digest(folder)}"
    (folder / UPRIGHT_NOTE).write_text("\n".join([note, *searched, ""]), "utf-8")


def searched_in(folder: Path) -> set[str]:
    """Names of the pictures that :func:`mark_as_shown` noted for the present model; empty if the model has no mark."""
    return {*(folder / UPRIGHT_NOTE).read_text("utf-8").split("\n")[1:-1]} if is_as_shown(folder) else set()


def is_as_shown(folder: Path) -> bool:
    """Tell whether :func:`mark_as_shown` marked the present model of a folder."""
    there = all((folder / name).is_file() for name in (UPRIGHT_NOTE, "images.bin"))
    return there and _digest(folder) in (folder / UPRIGHT_NOTE).read_text("utf-8", "replace")


def _digest(folder: Path) -> str:
    return hashlib.sha256((folder / "images.bin").read_bytes()).hexdigest()


class Taken(NamedTuple):
    """A picture that COLMAP registered.

    Attributes:
        name: the picture's path under ``images``.
        c2w: ``[3, 4]`` camera to world, OpenGL axes.
        camera: the camera's number.
        points: ids of the 3D points that the picture sees.
    """

    name: str
    c2w: Float64[np.ndarray, "3 4"]
    camera: int
    points: Int64[np.ndarray, " p"]


class Cursor:
    """Reader of a binary file from start to end; lengths that the file claims are checked before use."""

    def __init__(self, path: Path):
        self.path, self.at = path, 0
        self.places: list[tuple[int, int]] = []
        if path.suffix == ".txt":
            self.data, self.places = as_binary(path)
        else:
            self.data = read_bytes(path, "a file of COLMAP's binary model")

    def fault(self, found: str, expected: str) -> DataError:
        line = next((line for start, line in reversed(self.places) if start < self.at), None)
        return DataError(self.path, f"{found} {f'at byte {self.at}' if line is None else f'on line {line}'}", expected)

    def need(self, count: int, size: int, what: str) -> None:
        """Refuse ``count`` things of ``size`` bytes or more that are larger than the rest of the file."""
        left = len(self.data) - self.at
        if count * size > left:
            raise self.fault(f"{count} {what}", f"what fits the {left} bytes that follow: the file is cut or damaged")

    def take(self, kinds: str, what: str) -> tuple:
        """Read numbers of these types, in :mod:`struct`'s letters, little-endian, packed; DataError: the file ends."""
        form = struct.Struct(f"<{kinds}")
        self.need(1, form.size, what)
        self.at += form.size
        return form.unpack_from(self.data, self.at - form.size)

    def count(self, size: int, what: str) -> int:
        """Read a count of items that follow, of at least ``size`` bytes each."""
        (count,) = self.take("Q", f"number of {what}")
        self.need(count, size, what)
        return count

    def text(self, what: str) -> str:
        """Read a text that ends in a zero byte, else raise a DataError that asks for ``what``."""
        end = self.data.find(b"\0", self.at)
        try:
            text = self.data[self.at : end].decode() if end >= 0 else ""
        except UnicodeDecodeError:
            text = ""
        if not text:
            raise self.fault(f"no {what}", "a text in UTF-8 that ends in a zero byte")
        self.at = end + 1
        return text


def as_binary(path: Path) -> tuple[bytes, list[tuple[int, int]]]:
    """Pack ``cameras.txt``, ``images.txt`` or ``points3D.txt`` into what COLMAP's binary file would hold.

    Returns:
        The bytes, and for each record its offset in them and its line in the text.

    Raises:
        DataError: a line has other fields; the message shows it.
    """
    pack, expected = TEXT_LAYOUTS[path.stem]
    content = read_bytes(path, "a file of COLMAP's text model")
    lines = enumerate(content.decode(json.detect_encoding(content), "replace").splitlines(), 1)  # also Windows' UTF-16
    parts, places, length = [], [], 8  # the count comes first
    for number, line in lines:
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        after = next(lines, (0, ""))[1] if pack is pack_image else ""
        try:
            parts.append(pack(line.strip(), after))
        except (ValueError, struct.error, OverflowError) as error:
            raise DataError(path, f"line {number}, {line!r} ({error})", expected) from error
        places.append((length, number))
        length += len(parts[-1])
    return struct.pack("<Q", len(parts)) + b"".join(parts), places


def decimal(text: str) -> float:
    return math.nan if NOT_A_NUMBER.match(text) else float(text)


def pack_camera(line: str, _: str) -> bytes:
    number, model, width, height, *values = line.split()
    if model not in MODEL_NAMES:
        raise ValueError(repr(model))
    if len(values) != MODEL_PARAMETERS.get(model, len(values)):
        raise ValueError(f"{len(values)} parameters, {model} has {MODEL_PARAMETERS[model]}")
    head = struct.pack("<iiQQ", int(number), MODEL_NAMES.index(model), int(width), int(height))
    return head + struct.pack(f"<{len(values)}d", *map(decimal, values))


def pack_image(line: str, after: str) -> bytes:
    number, *pose, camera, name = line.split(maxsplit=9)
    seen = after.split()
    if len(seen) % 3:
        raise ValueError(f"{len(seen)} numbers on the line after it, which holds three a point, or is empty")
    points = zip(seen[::3], seen[1::3], seen[2::3], strict=True)
    points = b"".join(struct.pack("<ddq", decimal(x), decimal(y), int(point)) for x, y, point in points)
    head = struct.pack("<i7di", int(number), *map(decimal, pose), int(camera))
    return head + name.encode() + b"\0" + struct.pack("<Q", len(seen) // 3) + points


def pack_point(line: str, _: str) -> bytes:
    number, *position = line.split()[:4]
    return struct.pack("<Q3d11xQ", int(number), *map(decimal, position), 0)


TEXT_LAYOUTS: dict[str, tuple[Callable[[str, str], bytes], str]] = {
    "cameras": (pack_camera, "ID MODEL WIDTH HEIGHT PARAMETERS"),
    "images": (pack_image, "ID QW QX QY QZ TX TY TZ CAMERA NAME, and its points X Y POINT on the next line"),
    "points3D": (pack_point, "ID X Y Z R G B ERROR TRACK"),
}
"""By file: the function that packs a line of text, with the next line, and what the line holds."""


def read_cameras(path: Path) -> dict[int, Intrinsics | DataError]:
    """Read cameras by their ids; a camera with impossible values is replaced by the error that describes it."""
    cursor = Cursor(path)
    cameras = {}
    for _ in range(cursor.count(24, "cameras")):
        number, model, width, height = cursor.take("iiQQ", "camera")
        name = MODEL_NAMES[model] if 0 <= model < len(MODEL_NAMES) else f"number {model}"
        if name not in MODEL_PARAMETERS:
            way = "pictures cut out of the panorama" if name == "EQUIRECTANGULAR" else UNDISTORT
            raise cursor.fault(f"camera {number} of model {name}", f"one of {', '.join(MODEL_PARAMETERS)}: {way}")
        values = cursor.take(f"{MODEL_PARAMETERS[name]}d", f"parameters of camera {number}")
        try:
            if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
                raise cursor.fault(f"camera {number} of {width}x{height} pixels", f"sides from 1 to {MAX_SIDE}")
            own = parameters(cursor, name, values)
            cameras[number] = Intrinsics(float(width), float(height), *own, f"camera {number}")
        except DataError as fault:
            cameras[number] = fault
    return cameras


def parameters(cursor: Cursor, name: str, values: tuple[float, ...]) -> tuple:
    """Turn a camera model's parameters into fx, fy, cx, cy and the distortion (k1, k2, p1, p2, k3).

    Raises a DataError for a focal length that is not > 0, infinities, and k4 to k6.
    """
    if not all(-1e9 < value < 1e9 for value in values):
        raise cursor.fault(f"camera parameters {values}", "finite numbers")
    single = name.startswith("SIMPLE") or name == "RADIAL"
    focal, (cx, cy, *rest) = (values[:1] * 2, values[1:]) if single else (values[:2], values[2:])
    if not min(focal) >= 1e-3:
        raise cursor.fault(f"focal lengths {focal}", "numbers of pixels > 0")
    if any(rest[5:]):
        raise cursor.fault(f"FULL_OPENCV with k4, k5, k6 = {tuple(rest[5:])}", f"zeros there: {UNDISTORT}")
    k1, k2, p1, p2, k3, *_ = (*rest, *[0.0] * 5)
    return *focal, cx, cy, (k1, k2, 0.0, 0.0, 0.0) if single else (k1, k2, p1, p2, k3)


def read_images(path: Path, cameras: dict[int, Intrinsics | DataError]) -> list[Taken | DataError]:
    """Read the registered pictures; one with an impossible pose or camera is replaced by the error that says so."""
    cursor = Cursor(path)
    taken = []
    for _ in range(cursor.count(73, "pictures")):
        number, *pose, camera = cursor.take("i7di", "picture")
        if camera not in cameras:
            known = f"one of the {len(cameras)} in cameras{path.suffix}"
            raise cursor.fault(f"picture {number} of camera {camera}", known)
        fault = cameras[camera] if isinstance(cameras[camera], DataError) else None
        try:
            c2w = camera_to_world(cursor, number, np.array(pose))
        except DataError as error:
            fault = error
        name = cursor.text(f"name of picture {number}")
        count = cursor.count(24, f"points of picture {number}")
        # x, y, and the 3D point's number or -1.
        rows = np.frombuffer(cursor.data, dtype="<i8", count=3 * count, offset=cursor.at).reshape(count, 3)
        cursor.at += 24 * count
        taken.append(fault or Taken(name, c2w, camera, rows[rows[:, 2] >= 0, 2].astype(np.int64)))
    return taken


def usable(pictures: Sequence[Taken | DataError]) -> list[Taken]:
    """Leave out pictures that are errors, with one warning; the first error is raised where all are errors."""
    faults = [each for each in pictures if isinstance(each, DataError)]
    if faults and len(faults) == len(pictures):
        raise faults[0]
    if faults:
        warnings.warn(f"{faults[0]}; {len(faults)} of {len(pictures)} pictures are left out for such", stacklevel=2)
    return [each for each in pictures if isinstance(each, Taken)]


def camera_to_world(cursor: Cursor, number: int, pose: Float64[np.ndarray, " 7"]) -> Float64[np.ndarray, "3 4"]:
    """OpenGL's camera to world out of COLMAP's world to camera (y down, z forward): a quaternion and a translation.

    Raises a DataError for a pose that is no camera's.
    """
    small = np.abs(pose).max() <= MAX_COORDINATE  # false for NaN
    length = np.linalg.norm(pose[:4]) if small else 0.0
    if not 0.9 < length < 1.1:
        expected = f"a quaternion of length 1 and a translation below {MAX_COORDINATE:g}"
        raise cursor.fault(f"picture {number} with the pose {pose.tolist()}", expected)
    turn = Rotation.from_quat(np.roll(pose[:4], -1)).as_matrix()
    return np.concatenate([turn.T * [1.0, -1.0, -1.0], -(turn.T @ pose[4:])[:, None]], axis=1)


def read_points(path: Path) -> tuple[Int64[np.ndarray, " p"], Float64[np.ndarray, "p 3"]]:
    """Read the points' ids, in order, and positions ``[P, 3]``, without those that are absurdly far away."""
    cursor = Cursor(path)
    numbers, positions = [], []
    for _ in range(cursor.count(51, "points")):
        number, x, y, z = cursor.take("Q3d11x", "point")
        track = cursor.count(8, f"pictures of point {number}")
        cursor.at += 8 * track
        if all(abs(value) <= MAX_COORDINATE for value in (x, y, z)):
            numbers.append(number)
            positions.append((x, y, z))
    numbers = np.array(numbers, dtype=np.uint64).astype(np.int64)
    order = np.argsort(numbers)
    return numbers[order], np.array(positions, dtype=np.float64).reshape(-1, 3)[order]
