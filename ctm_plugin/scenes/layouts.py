"""The two layouts that renderings are written in: Synthetic-NeRF's (Blender) and LLFF's. See docs/scenes.md."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from ctm_plugin.files import write_json
from ctm_plugin.scenes.encode import DEPTH_SCALE, write_npy


def view_path(out: Path, split: str, index: int) -> Path:
    """Say where a picture goes: ``train/r_0.png``, and views of a forward-facing scene to ``images/view_000.png``."""
    return out / "images" / f"view_{index:03d}.png" if split == "all" else out / split / f"r_{index}.png"


def depth_path(out: Path, split: str, index: int, suffix: str) -> Path:
    """Say where a depth goes: next to its picture, or into the folder ``depth`` in LLFF's layout."""
    picture = view_path(out, split, index)
    if split == "all":
        return out / "depth" / f"{picture.stem}{suffix}"
    return picture.with_name(f"{picture.stem}_depth{suffix}")


def write_transforms(
    out: Path, split: str, poses: np.ndarray, camera_angle_x: float, near: float, far: float, suffix: str
) -> None:
    """Write ``transforms_<split>.json``; test frames also name their depth.

    Args:
        out: the data set's folder.
        split: ``train`` or ``test``.
        poses: ``[N, 4, 4]`` camera to world.
        camera_angle_x: in radians.
        near, far: bounds along the rays in scene units.
        suffix: of the depth files: ``.npy`` holds scene units, ``.png`` steps of ``DEPTH_SCALE``.
    """
    frames = [{"file_path": f"./{split}/r_{i}", "transform_matrix": pose.tolist()} for i, pose in enumerate(poses)]
    content: dict[str, object] = {"camera_angle_x": camera_angle_x, "near": near, "far": far}
    if split == "test":
        content["depth_scale"] = DEPTH_SCALE if suffix == ".png" else 1.0
        for frame in frames:
            frame["depth_file_path"] = f"{frame['file_path']}_depth{suffix}"
    write_json(out / f"transforms_{split}.json", {**content, "frames": frames})


def write_poses_bounds(
    out: Path, poses: np.ndarray, camera_angle_x: float, size: tuple[int, int], bounds: np.ndarray
) -> None:
    """Write LLFF's ``poses_bounds.npy``: ``[N, 17]`` float64.

    A row is a 3x5 matrix, row by row, then near and far: the camera's axes (down, right, back) and its position in the
    world as columns, and (height, width, focal length) in pixels as the fifth.

    Args:
        out: the data set's folder.
        poses: ``[N, 4, 4]`` camera to world, OpenGL axes (right, up, back).
        camera_angle_x: in radians.
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
