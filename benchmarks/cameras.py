"""How near cameras that were found are to others of the same pictures.

``python benchmarks/cameras.py FOLDER OTHER``: two data sets, each with COLMAP's ``sparse/0`` or ``transforms*.json``;
pictures are told apart by their names without suffix. Centres are laid over one another by the similarity that fits
them best. ``python benchmarks/cameras.py noise PICTURES FOLDER 8`` writes pictures under an eighth of the light into
``FOLDER/images``, as a phone's sensor has them at a high ISO.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from ctm_plugin.color.srgb import linear_to_srgb, srgb_to_linear
from ctm_plugin.data.readers.colmap_model import read_cameras, read_images, usable

FULL_WELL, READ_NOISE = 5000, 3.0
"""Electrons: of a white pixel, and the standard deviation of what is read where there are none."""


def read(folder: Path) -> tuple[dict[str, np.ndarray], float]:
    """Camera to world ``[3, 4]`` by file name, and the mean focal length in pixels."""
    model = folder / "sparse" / "0"
    if model.is_dir():
        cameras = read_cameras(model / "cameras.bin")
        poses = {Path(taken.name).stem: taken.c2w for taken in usable(read_images(model / "images.bin", cameras))}
        return poses, float(np.mean([camera[2:4] for camera in cameras.values()]))
    poses, focal = {}, []
    for path in sorted(folder.glob("transforms*.json")):
        content = json.loads(path.read_text(encoding="utf-8"))
        poses |= {Path(each["file_path"]).stem: np.array(each["transform_matrix"])[:3] for each in content["frames"]}
        focal += [content["fl_x"], content["fl_y"]]
    return poses, float(np.mean(focal))


def errors(found: np.ndarray, true: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How far cameras ``[N, 3, 4]`` are off once their centres are laid over the others (Umeyama, PAMI 13(4), 1991).

    Returns:
        Distances between centres ``[N]``, in diameters of the other cameras' smallest ball about their mean; degrees
        between the cameras as the centres lay them over one another; and degrees that are left after one turn of all
        cameras, the best: centres in a line or a plane hardly say how cameras are turned about it.
    """
    here, there = found[..., 3] - found[..., 3].mean(0), true[..., 3] - true[..., 3].mean(0)
    turn, _ = Rotation.align_vectors(there, here)
    ours, theirs = Rotation.from_matrix(found[..., :3]), Rotation.from_matrix(true[..., :3])
    best = (theirs * ours.inv()).mean()
    scale = (turn.apply(here) * there).sum() / (here**2).sum()
    centre = np.linalg.norm(scale * turn.apply(here) - there, axis=-1) / (2 * np.linalg.norm(there, axis=-1).max())
    return centre, *(np.degrees((theirs.inv() * each * ours).magnitude()) for each in (turn, best))


def add_noise(pictures: Path, folder: Path, factor: float) -> None:
    """Write pictures under ``1 / factor`` of their light, with the noise of photons and of reading them."""
    chance = np.random.default_rng(0)
    folder.mkdir(parents=True)
    for path in sorted(pictures.iterdir()):
        codes = torch.from_numpy(np.array(Image.open(path).convert("RGB"))).double() / 255
        light = (srgb_to_linear(codes) / factor * FULL_WELL).numpy()
        electrons = chance.poisson(light) + chance.normal(0, READ_NOISE, light.shape)
        noisy = linear_to_srgb(torch.from_numpy(electrons / FULL_WELL).clamp(0, 1))
        Image.fromarray((noisy * 255).round().byte().numpy()).save(folder / f"{path.stem}.png")


def main() -> None:
    if sys.argv[1] == "noise":
        return add_noise(Path(sys.argv[2]), Path(sys.argv[3], "images"), float(sys.argv[4]))
    (found, focal), (true, other) = (read(Path(folder)) for folder in sys.argv[1:3])
    both = sorted(found.keys() & true.keys())
    off = errors(np.stack([found[name] for name in both]), np.stack([true[name] for name in both]))
    centre, turn, rest = ((each.mean(), each.max()) for each in (100 * off[0], *off[1:]))
    print(f"{len(found)} pictures, {len(both)} of the {len(true)} that the other has; mean, largest in brackets")
    print(f"centres {centre[0]:.2f} ({centre[1]:.2f}) % of the extent, median {100 * np.median(off[0]):.2f}")
    print("rotation {:.2f} ({:.2f}) degrees by the centres' alignment".format(*turn))
    print("rotation {:.2f} ({:.2f}) degrees beside one turn of all".format(*rest))
    print(f"focal length {focal:.1f}, the other {other:.1f}: {100 * (focal / other - 1):+.1f} %")


if __name__ == "__main__":
    main()
