"""The files of a rendering: sRGB with straight alpha, depth, and cameras in Synthetic-NeRF's layout or LLFF's.

See docs/scenes.md.
"""

from __future__ import annotations

import math
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import torch

from ctm_plugin.color.srgb import linear_to_srgb
from ctm_plugin.files import replacing, write_json

DEPTH_SCALE = 1.0 / 4096.0
"""Scene units in one step of a depth picture; the largest depth is just under 16 units."""


def scale_of(depth: str) -> float:
    """Scene units in one step of a depth file, ``float`` or ``code``."""
    return 1.0 if depth == "float" else DEPTH_SCALE


def to_rgba8(premultiplied: np.ndarray) -> np.ndarray:
    """Turn linear colour with premultiplied alpha, as renderers give it, into 8-bit sRGB with straight alpha.

    ``colour = round(255 sRGB(premultiplied / alpha))``; colour is 0 where the rounded alpha is 0.

    Args:
        premultiplied: ``[H, W, 4]`` float, to uint8.
    """
    alpha = np.clip(premultiplied[..., 3:].astype(np.float64), 0.0, 1.0)
    light = np.clip(premultiplied[..., :3] / np.maximum(alpha, 1e-6), 0.0, 1.0)
    colour = linear_to_srgb(torch.from_numpy(light)).numpy()
    rgba = np.rint(255.0 * np.concatenate([colour, alpha], axis=-1)).astype(np.uint8)
    rgba[rgba[..., 3] == 0] = 0
    return rgba


def encode_depth(depth: np.ndarray) -> np.ndarray:
    """Turn distances ``[...]`` into 16 bits: ``round(depth / DEPTH_SCALE)``, 0 where nothing was hit (NaN).

    Raises:
        ValueError: a depth does not fit.
    """
    code = np.rint(depth / DEPTH_SCALE)
    if np.any(code < 1) or np.any(code > 65535):
        raise ValueError(f"encode_depth: depth outside ({DEPTH_SCALE}, {65535 * DEPTH_SCALE}]")
    return np.nan_to_num(code, nan=0.0).astype(np.uint16)


def decode_depth(code: np.ndarray) -> np.ndarray:
    """Undo :func:`encode_depth`: ``[...]`` uint16 to float32 scene units, NaN where the code is 0."""
    return np.where(code == 0, np.nan, code * DEPTH_SCALE).astype(np.float32)


def write_png(path: Path, image: np.ndarray) -> None:
    """Write ``[H, W]`` uint16 or ``[H, W, C]`` uint8 as a PNG, compressed as far as zlib goes, whole or not at all."""
    with replacing(path) as beside:
        beside.write_bytes(iio.imwrite("<bytes>", image, extension=".png", optimize=True, compress_level=9))


def write_npy(path: Path, array: np.ndarray) -> None:
    """Write an array ``[...]``, whole or not at all."""
    with replacing(path) as beside, open(beside, "wb") as file:
        np.save(file, array, allow_pickle=False)


def view_path(out: Path, split: str, index: int) -> Path:
    """Say where a picture goes: ``train/r_0.png``, and views of a forward-facing scene to ``images/view_000.png``."""
    return out / "images" / f"view_{index:03d}.png" if split == "all" else out / split / f"r_{index}.png"


def depth_path(out: Path, split: str, index: int) -> Path:
    """Say where a depth goes, without a suffix: next to its picture, or into the folder ``depth`` of LLFF's layout."""
    return out / "depth" / f"view_{index:03d}" if split == "all" else out / split / f"r_{index}_depth"


def write_transforms(
    out: Path, split: str, poses: np.ndarray, camera_angle_x: float, near: float, far: float, depth: str
) -> None:
    """Write ``transforms_<split>.json``; test frames also name their depth.

    Args:
        out, split: the data set's folder, and ``train`` or ``test``.
        poses, camera_angle_x: ``[N, 4, 4]`` camera to world, and radians.
        near, far: bounds along the rays in scene units.
        depth: of the files: ``float`` (``.npy`` in scene units) or ``code`` (``.png`` in steps of ``DEPTH_SCALE``).
    """
    frames = [{"file_path": f"./{split}/r_{i}", "transform_matrix": pose.tolist()} for i, pose in enumerate(poses)]
    content: dict[str, object] = {"camera_angle_x": camera_angle_x, "near": near, "far": far}
    if split == "test":
        content["depth_scale"] = scale_of(depth)
        for frame in frames:
            frame["depth_file_path"] = f"{frame['file_path']}_depth.{'npy' if depth == 'float' else 'png'}"
    write_json(out / f"transforms_{split}.json", {**content, "frames": frames})


def write_poses_bounds(
    out: Path, poses: np.ndarray, camera_angle_x: float, size: tuple[int, int], bounds: np.ndarray
) -> None:
    """Write LLFF's ``poses_bounds.npy``: ``[N, 17]`` float64.

    A row is a 3x5 matrix, row by row, then near and far: the camera's axes (down, right, back) and its position in the
    world as columns, and (height, width, focal length) in pixels as the fifth.

    Args:
        out: the data set's folder.
        poses, camera_angle_x: ``[N, 4, 4]`` camera to world, OpenGL axes (right, up, back), and radians.
        size: width and height in pixels.
        bounds: ``[N, 2]`` depth along the viewing axis of what each view sees, nearest and farthest.
    """
    width, height = size
    focal = 0.5 * width / math.tan(0.5 * camera_angle_x)
    right, up, back, eye = np.moveaxis(poses[:, :3, :], -1, 0)
    hwf = np.broadcast_to([float(height), float(width), focal], eye.shape)
    matrix = np.stack([-up, right, back, eye, hwf], axis=-1)
    write_npy(out / "poses_bounds.npy", np.concatenate([matrix.reshape(len(poses), 15), bounds], axis=1))


def axial_bounds(distance: np.ndarray, camera_angle_x: float) -> tuple[float, float]:
    """Find the nearest and farthest depth along the viewing axis, leaving a thousandth of the pixels out at either end.

    Args:
        distance: ``[H, W]`` along the rays through the pixels' centres, NaN for nothing.
        camera_angle_x: in radians.

    Returns:
        LLFF's bounds of one view; NaN where nothing is seen.
    """
    height, width = distance.shape
    focal = 0.5 * width / math.tan(0.5 * camera_angle_x)
    x = (np.arange(width) + 0.5 - 0.5 * width) / focal
    y = (np.arange(height) + 0.5 - 0.5 * height) / focal
    depth = distance / np.sqrt(1.0 + x[None, :] ** 2 + y[:, None] ** 2)
    if np.isnan(depth).all():
        return math.nan, math.nan
    near, far = np.nanquantile(depth, [0.001, 0.999])
    return float(near), float(far)
