"""How near cameras that were found are to others of the same pictures.

``python benchmarks/cameras.py FOLDER OTHER``: two data sets, each with COLMAP's ``sparse/0`` or ``transforms*.json``;
pictures are told apart by their file names. Centres are laid over one another by the similarity that fits them best.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from ctm_plugin.data.readers.colmap_model import read_cameras, read_images, usable

Poses = Float64[np.ndarray, "n 3 4"]


class Errors(NamedTuple):
    """Of each camera.

    Attributes:
        centre: ``[N]`` distances between centres, in diameters of the other cameras' smallest ball about their mean.
        turn: ``[N]`` degrees between the cameras as the centres lay them over one another.
        rest: ``[N]`` degrees that are left after one turn of all cameras, the best: centres in a line or a plane hardly
            say how cameras are turned about it.
    """

    centre: Float64[np.ndarray, " n"]
    turn: Float64[np.ndarray, " n"]
    rest: Float64[np.ndarray, " n"]


def read(folder: Path) -> tuple[dict[str, np.ndarray], float]:
    """Camera to world ``[3, 4]`` by file name, and the mean focal length in pixels."""
    model = folder / "sparse" / "0"
    if model.is_dir():
        cameras = read_cameras(model / "cameras.bin")
        poses = {Path(taken.name).name: taken.c2w for taken in usable(read_images(model / "images.bin", cameras))}
        return poses, float(np.mean([camera[2:4] for camera in cameras.values()]))
    poses, focal = {}, []
    for path in sorted(folder.glob("transforms*.json")):
        content = json.loads(path.read_text(encoding="utf-8"))
        poses |= {Path(each["file_path"]).name: np.array(each["transform_matrix"])[:3] for each in content["frames"]}
        focal += [content["fl_x"], content["fl_y"]]
    return poses, float(np.mean(focal))


def errors(found: Poses, true: Poses) -> Errors:
    """How far cameras are off once they are laid over the others (Umeyama, PAMI 13(4), 1991).

    Args:
        found, true: ``[N, 3, 4]`` camera to world, the same cameras in the same order, N >= 3, centres not in a line.
    """
    here, there = found[..., 3] - found[..., 3].mean(0), true[..., 3] - true[..., 3].mean(0)
    rotation = nearest_rotation(there.T @ here)
    turned = here @ rotation.T
    scale = (turned * there).sum() / (here**2).sum()
    extent = 2 * np.linalg.norm(there, axis=-1).max()
    best = nearest_rotation(np.einsum("nij,nkj->ik", true[..., :3], found[..., :3]))
    return Errors(
        np.linalg.norm(scale * turned - there, axis=-1) / extent,
        degrees_between(rotation @ found[..., :3], true[..., :3]),
        degrees_between(best @ found[..., :3], true[..., :3]),
    )


def nearest_rotation(matrix: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"]:
    """The rotation R with the largest trace of R^T M."""
    left, _, right = np.linalg.svd(matrix)
    return left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right


def degrees_between(one: Float64[np.ndarray, "n 3 3"], other: Float64[np.ndarray, "n 3 3"]) -> np.ndarray:
    """Of the rotations from one to the other."""
    return np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(one - other, axis=(1, 2)) / 8**0.5, 0, 1)))


def main() -> None:
    (found, focal), (true, other) = (read(Path(folder)) for folder in sys.argv[1:3])
    both = sorted(found.keys() & true.keys())
    off = errors(np.stack([found[name] for name in both]), np.stack([true[name] for name in both]))
    print(f"{len(found)} pictures, {len(both)} of the {len(true)} that the other has; mean, largest in brackets")
    print(f"centres {100 * off.centre.mean():.2f} ({100 * off.centre.max():.2f}) % of the extent")
    print(f"rotation {off.turn.mean():.2f} ({off.turn.max():.2f}) degrees by the centres' alignment")
    print(f"rotation {off.rest.mean():.2f} ({off.rest.max():.2f}) degrees beside one turn of all")
    print(f"focal length {focal:.1f}, the other {other:.1f}: {100 * (focal / other - 1):+.1f} %")


if __name__ == "__main__":
    main()
