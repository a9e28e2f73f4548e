"""Tiny valid data sets in every layout, written by the formats' descriptions."""

import json
import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
from ctm_scenes.layouts import write_poses_bounds
from ctm_scenes.trajectory import forward_facing, hemisphere
from dng import write_dng
from PIL import Image
from scipy.spatial.transform import Rotation

from ctm_plugin.data.readers.colmap_model import read_cameras, read_images, read_points

SIZE = 8
"""Of the pictures in Blender's layout."""


def blender_layout(root: Path, train: int = 3, test: int = 2, channels: int = 4, depth: bool = False) -> Path:
    """A data set in Blender layout with random 8x8 pictures; depth of test views in steps of 0.25, 0 for nothing."""
    rng = np.random.default_rng(0)
    for split, count in (("train", train), ("test", test)):
        (root / split).mkdir(parents=True)
        content: dict = {"camera_angle_x": 0.7, "frames": []}
        if depth and split == "test":
            content["depth_scale"] = 0.25
        for index, pose in enumerate(hemisphere(count, 4.0, seed=1)):
            name = f"./{split}/r_{index}"
            Image.fromarray(rng.integers(0, 256, (SIZE, SIZE, channels), dtype=np.uint8)).save(root / f"{name}.png")
            frame = {"file_path": name, "transform_matrix": pose.tolist()}
            if depth and split == "test":
                code = rng.integers(0, 30, (SIZE, SIZE)).astype(np.uint16)
                Image.fromarray(code).save(root / f"{name}_depth.png")
                frame["depth_file_path"] = f"{name}_depth.png"
            content["frames"].append(frame)
        (root / f"transforms_{split}.json").write_text(json.dumps(content))
    return root


LENS = {"k1": -0.1, "k2": 0.02, "p1": 0.001, "p2": -0.002}
INTRINSICS = {"w": 16, "h": 12, "fl_x": 20.0, "fl_y": 19.0, "cx": 8.5, "cy": 5.5}
HOUSE = {"camera_model": "OPENCV", **INTRINSICS, **LENS, "near": 1.0, "far": 7.0}
"""What a whole ``transforms.json`` has beside its frames."""


def transforms_layout(root: Path, poses: np.ndarray, channels: int = 3, **content: Any) -> Path:
    """Random pictures of 16x12 and a ``transforms.json`` with this content, its frames not in order."""
    rng = np.random.default_rng(0)
    (root / "images").mkdir(parents=True)
    frames = []
    for index, pose in enumerate(poses):
        name = f"images/f_{index:02d}.png"
        iio.imwrite(root / name, rng.integers(0, 256, (12, 16, channels), dtype=np.uint8))
        frames.append({"file_path": f"./{name}", "transform_matrix": pose.tolist()})
    (root / "transforms.json").write_text(json.dumps({**content, "frames": frames[::-1]}))
    return root


ROOM_EYE, ROOM_TARGET = np.array([1.0, -4.0, 2.0]), np.array([0.5, 1.0, 1.0])
ROOM_ANGLE = 0.9


def room_poses(count: int = 11) -> np.ndarray:
    return forward_facing(count, ROOM_EYE, ROOM_TARGET, (0.6, 0.4), seed=1)


def llff_layout(root: Path, size: tuple[int, int], count: int = 11) -> Path:
    """A wall at y = 1 with a square drawn on it, in pictures of this width and height, with depth."""
    width, height = size
    focal = 0.5 * width / math.tan(0.5 * ROOM_ANGLE)
    (root / "images").mkdir(parents=True)
    (root / "depth").mkdir()
    bounds = []
    for index, pose in enumerate(room_poses(count)):
        x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
        ray = np.stack([x / focal, -y / focal, -np.ones_like(x)], axis=-1) @ pose[:3, :3].T
        along = (1.0 - pose[1, 3]) / ray[..., 1]
        point = pose[:3, 3] + along[..., None] * ray
        inside = (np.abs(point[..., 0] - 0.5) < 1) & (np.abs(point[..., 2] - 1.0) < 1)
        image = np.where(inside[..., None], [200, 40, 40], [30, 60, 90]).astype(np.uint8)
        iio.imwrite(root / f"images/view_{index:03d}.png", image)
        np.save(root / f"depth/view_{index:03d}.npy", (along * np.linalg.norm(ray, axis=-1)).astype(np.float32))
        bounds.append([along.min(), along.max()])
    write_poses_bounds(root, room_poses(count), ROOM_ANGLE, size, np.array(bounds))
    return root


def rawnerf_layout(root: Path, camera: np.ndarray, count: int = 9, angle: float = 0.9) -> Path:
    """A wall that looks the same everywhere, ``camera``, in DNGs of equal exposure with their EXIF data."""
    (root / "raw").mkdir(parents=True)
    for index in range(count):
        write_dng(root / f"raw/IMG_{index:03d}.dng", camera)
        (root / f"raw/IMG_{index:03d}.json").write_text(json.dumps([{"ShutterSpeed": "1/30", "ISO": 800}]))
    poses = forward_facing(count, np.array([0.0, -4.0, 0.0]), np.array([0.0, 1.0, 0.0]), (0.6, 0.4), seed=1)
    write_poses_bounds(root, poses, angle, (camera.shape[1], camera.shape[0]), np.tile([2.0, 6.0], (count, 1)))
    return root


COUNT, YARD_SIZE = 9, (24, 16)
NAMES = [f"f_{index:02d}.png" for index in range(COUNT)]
"""Of the yard's pictures."""
OPENCV = (4, (30.0, 29.0, 12.5, 7.5, -0.08, 0.01, 0.001, -0.002))
POINTS = np.array([[0.5, 0, 0], [-1, 0.2, 0.1], [0, 1, -0.5], [0, 0, 1.0]])


def colmap_layout(root: Path, poses: np.ndarray, camera: tuple[int, tuple[float, ...]] = OPENCV) -> Path:
    """Pictures of 24x16 of one colour each, all of which see ``POINTS``, in COLMAP's binary model."""
    model = root / "sparse" / "0"
    model.mkdir(parents=True)
    (root / "images").mkdir()
    names = [f"f_{index:02d}.png" for index in range(len(poses))]
    width, height = YARD_SIZE
    for index, name in enumerate(names):
        iio.imwrite(root / "images" / name, np.full((height, width, 3), 10 * index + 5, dtype=np.uint8))
    write_camera(model / "cameras.bin", *camera)
    write_images(model / "images.bin", poses, [[10, 11, 12, 13]] * len(poses), names)
    write_points(model / "points3D.bin", POINTS)
    return root


def write_camera(path: Path, model: int, values: tuple[float, ...], size: tuple[int, int] = YARD_SIZE) -> None:
    """Camera 1, of a model with these parameters, of pictures of this width and height."""
    path.write_bytes(struct.pack(f"<QiiQQ{len(values)}d", 1, 1, model, *size, *values))


def world_to_camera(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """COLMAP's quaternion (w, x, y, z) and translation of an OpenGL camera to world."""
    turn = (pose[:3, :3] * [1, -1, -1]).T
    x, y, z, w = Rotation.from_matrix(turn).as_quat()
    return np.array([w, x, y, z]), -turn @ pose[:3, 3]


def write_images(path: Path, poses: np.ndarray, points: list[list[int]], names: list[str], camera: int = 1) -> None:
    data = struct.pack("<Q", len(poses))
    # COLMAP's order is not that of names.
    for index in reversed(range(len(poses))):
        quaternion, translation = world_to_camera(poses[index])
        data += struct.pack("<i7di", index + 5, *quaternion, *translation, camera) + names[index].encode() + b"\0"
        data += struct.pack("<Q", len(points[index]) + 1) + struct.pack("<ddq", 1.0, 2.0, -1)
        data += b"".join(struct.pack("<ddq", 3.5, 4.5, number) for number in points[index])
    path.write_bytes(data)


def write_points(path: Path, positions: np.ndarray) -> None:
    """Points 10, 11, ... with tracks of different length."""
    data = struct.pack("<Q", len(positions))
    for index, position in enumerate(positions):
        track = index % 3
        data += struct.pack("<Q3d3Bd", index + 10, *position, 1, 2, 3, 0.5) + struct.pack("<Q", track)
        data += struct.pack("<ii", 5, 0) * track
    path.write_bytes(data)


def as_text(root: Path) -> None:
    """The same model as COLMAP's own text, by its documented format, in the place of the binary one."""
    model = root / "sparse/0"
    cameras = read_cameras(model / "cameras.bin")
    taken, (numbers, positions) = read_images(model / "images.bin", cameras), read_points(model / "points3D.bin")
    values = " ".join(map(repr, OPENCV[1]))
    (model / "cameras.txt").write_text(f"# Camera list\n#   CAMERA_ID, ...\n1 OPENCV 24 16 {values}\n")
    lines = ["# Image list with two lines of data per image:"]
    for index, each in enumerate(taken):
        turn, shift = world_to_camera(each.c2w)
        lines.append(f"{index} {' '.join(map(repr, map(float, [*turn, *shift])))} 1 {each.name}")
        lines.append(" ".join(f"1.5 2.5 {point}" for point in [*each.points, -1]))
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    points = zip(numbers, positions.tolist(), strict=True)
    (model / "points3D.txt").write_text("".join(f"{n} {x!r} {y!r} {z!r} 1 2 3 0.5 5 0\n" for n, (x, y, z) in points))
    for path in model.glob("*.bin"):
        path.unlink()


def write_ply(path: Path, points: np.ndarray, encoding: str, kind: str = "float") -> None:
    """Points with colours, as nerfstudio writes them."""
    names = "".join(f"property {kind} {axis}\n" for axis in "xyz")
    names += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    head = f"ply\nformat {encoding} 1.0\ncomment of a test\nelement vertex {len(points)}\n{names}end_header\n"
    if encoding == "ascii":
        body = "".join(f"{x:.9g} {y:.9g} {z:.9g} 1 2 3\n" for x, y, z in points).encode()
    else:
        body = b"".join(struct.pack(f"<3{kind[0]}3B", *point, 1, 2, 3) for point in points)
    path.write_bytes(head.encode() + body)


MAKE: dict[str, Callable[[Path], Path]] = {
    "blender": lambda root: blender_layout(root, depth=True),
    "transforms": lambda root: transforms_layout(root, hemisphere(5, 4.0, seed=3), **HOUSE),
    "colmap": lambda root: colmap_layout(root, hemisphere(5, 4.0, seed=3)),
    "llff": lambda root: llff_layout(root, (24, 16), 5),
    "rawnerf": lambda root: rawnerf_layout(root, np.full((32, 48, 3), 0.1), 5),
}
"""The smallest of each layout."""
