"""Writing of COLMAP's binary models, which :mod:`ctm_plugin.data.readers.colmap_model` reads, with numpy and scipy."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from ctm_plugin.data.readers.colmap_model import MODEL_NAMES, MODEL_PARAMETERS, Taken
from ctm_plugin.data.readers.lens import PINHOLE, Intrinsics
from ctm_plugin.files import replacing


def write_model(
    folder: Path,
    cameras: Sequence[Intrinsics],
    taken: Sequence[Taken],
    places: Sequence[Float[np.ndarray, "_ 2"]],
    positions: Float[np.ndarray, "p 3"],
    colors: UInt8[np.ndarray, "p 3"],
) -> None:
    """Write ``cameras.bin``, ``images.bin`` and ``points3D.bin``, each whole or not at all.

    COLMAP counts from 1: camera ``cameras[c - 1]``, picture ``taken[i - 1]``, point ``positions[p - 1]``.

    Args:
        folder: the model's folder, which is created.
        cameras: ``PINHOLE``, ``OPENCV`` where they distort, ``FULL_OPENCV`` where k3 is not 0.
        taken: the pictures; ``camera`` and ``points`` are COLMAP's numbers.
        places: where each picture sees its points, in pixels.
        positions, colors: of all points, in the pictures' world, and sRGB.
    """
    folder.mkdir(parents=True, exist_ok=True)
    images = [packed_picture(*each) for each in enumerate(zip(taken, places, strict=True), 1)]
    parts = {
        "cameras": [packed_camera(*each) for each in enumerate(cameras, 1)],
        "images": images,
        "points3D": packed_points(taken, positions, colors),
    }
    for name, rows in parts.items():
        with replacing(folder / f"{name}.bin") as beside:
            beside.write_bytes(struct.pack("<Q", len(rows)) + b"".join(rows))


def packed_camera(number: int, camera: Intrinsics) -> bytes:
    """Pack a camera as the smallest of COLMAP's models that has its distortion."""
    k1, k2, p1, p2, k3 = camera.distortion
    name = "FULL_OPENCV" if k3 else "PINHOLE" if camera.distortion == PINHOLE else "OPENCV"
    values = (*camera.pinhole, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)[: MODEL_PARAMETERS[name]]
    size = int(camera.width), int(camera.height)
    return struct.pack(f"<iiQQ{len(values)}d", number, MODEL_NAMES.index(name), *size, *values)


def packed_picture(number: int, seen: tuple[Taken, Float[np.ndarray, "_ 2"]]) -> bytes:
    """Pack a picture: world to camera with OpenCV's axes as a quaternion and a translation, and what it sees."""
    picture, places = seen
    rotation = Rotation.from_matrix((picture.c2w[:, :3] * [1.0, -1.0, -1.0]).T)
    x, y, z, w = rotation.as_quat()
    pose = (w, x, y, z, *-rotation.apply(picture.c2w[:, 3]))
    rows = np.empty(len(places), [("place", "<f8", 2), ("point", "<i8")])
    rows["place"], rows["point"] = places, picture.points
    head = struct.pack("<i7di", number, *pose, picture.camera) + picture.name.encode() + b"\0"
    return head + struct.pack("<Q", len(rows)) + rows.tobytes()


def packed_points(
    taken: Sequence[Taken], positions: Float[np.ndarray, "p 3"], colors: UInt8[np.ndarray, "p 3"]
) -> list[bytes]:
    """Pack points with their tracks, picture and place of each sight; their error is -1, not measured."""
    counts = [len(each.points) for each in taken]
    sights = np.empty((sum(counts), 2), "<i4")
    sights[:, 0] = np.repeat(np.arange(1, len(taken) + 1), counts)
    sights[:, 1] = np.concatenate([np.arange(count) for count in counts])
    point = np.concatenate([each.points for each in taken]) - 1
    tracks = sights[np.argsort(point, kind="stable")]
    ends = np.cumsum(np.bincount(point, minlength=len(positions)))
    head, rows, start = struct.Struct("<Q3d3BdQ"), [], 0
    points = zip(positions.tolist(), colors.tolist(), ends.tolist(), strict=True)
    for number, (position, color, end) in enumerate(points, 1):
        rows.append(head.pack(number, *position, *color, -1.0, end - start) + tracks[start:end].tobytes())
        start = end
    return rows
