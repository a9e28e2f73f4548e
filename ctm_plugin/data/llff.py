"""The layout of LLFF: ``poses_bounds.npy`` beside ``images``, taken by hand in front of a scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64

from ctm_plugin.data.check import check_integer
from ctm_plugin.data.config import PhotoConfig, check_matched_background, check_root
from ctm_plugin.data.develop import develop, develop_depth
from ctm_plugin.data.files import IMAGE_SUFFIXES, require_folder, view_names
from ctm_plugin.data.images import map_numbers
from ctm_plugin.data.poses import MAX_COORDINATE, check_rotation, recentre
from ctm_plugin.data.rendering import read_depth_scale, read_light
from ctm_plugin.data.scene import Scene, Views
from ctm_plugin.errors import DataError

POSES = "poses_bounds.npy"
NEAREST = 0.75
"""The nearest bound is brought to a depth of 1 / 0.75, so that NDC's near plane, at 1, lies in front of everything."""


@dataclass(frozen=True, kw_only=True)
class LLFFConfig(PhotoConfig):
    """Which data set in LLFF layout, and how to read it.

    Attributes:
        root: folder with ``poses_bounds.npy`` and ``images``, or ``images_<downscale>`` where that is there.
        test_every: every ``test_every``-th view, the first one included, is for testing.

    The others are :class:`PhotoConfig`'s.

    Raises:
        ConfigError: a value is out of range.
    """

    root: str | Path
    test_every: int = 8
    background: str = "black"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_root(self.root)
        check_integer("dataset.test_every", self.test_every, 2)

    def load(self) -> Scene:
        """See :func:`load_llff`."""
        return load_llff(self)


def load_llff(config: LLFFConfig) -> Scene:
    """Read a data set in LLFF layout.

    The world is moved so that the mean camera stands at its origin and looks along -z, and scaled so that the nearest
    bound lies at depth ``1 / 0.75``, as NeRF does. Test views have depth where a folder ``depth`` holds it: ``.npy`` in
    units of the file's poses, or 16-bit PNG with ``depth_scale`` in ``settings.json``.

    Args:
        config: see :class:`LLFFConfig`.

    Returns:
        The scene, named as its folder, forward-facing; near is NDC's near plane, 1, far a distance along the rays that
        holds all that the bounds hold.

    Raises:
        DataError: a file is missing or cannot be used; the message names it.
        ConfigError: ``downscale`` does not divide the image size, or ``random_matched`` lacks alpha.
    """
    root = require_folder(config.root, f"a folder with {POSES} and images")
    c2w, hwf, bounds = read_poses(root / POSES)
    paths, shrunk = find_images(root, config.downscale)
    if len(paths) != len(c2w):
        raise DataError(root / POSES, f"{len(c2w)} poses", f"{len(paths)}, one for each picture in {paths[0].parent}")
    if len(c2w) < 2:
        raise DataError(root / POSES, "one pose", "at least two: one for testing, one to train on")

    scale = 1.0 / (NEAREST * bounds.min())
    c2w = recentre(c2w)
    c2w[:, :, 3] *= scale
    names = np.array(view_names(paths))
    testing = np.arange(len(paths)) % config.test_every == 0
    training = np.flatnonzero(~testing)[:: config.skip]
    photo = config if shrunk else replace(config, downscale=1)
    views = {}
    for split, chosen in (("train", training), ("test", np.flatnonzero(testing))):
        images = develop([paths[i] for i in chosen], list(names[chosen]), photo, noisy=split == "train")
        height, width = images.shape[1:3]
        views[split] = Views(
            images=images,
            c2w=torch.from_numpy(c2w[chosen]).to(torch.float32),
            intrinsics=torch.tensor([intrinsics(hwf[i], height, width, root / POSES) for i in chosen]),
            names=tuple(names[chosen].tolist()),
            depth=read_depths(root, [paths[i] for i in chosen], scale, photo.downscale, height, width)
            if split == "test"
            else None,
        )
    check_matched_background(config, views["train"], root)
    fx, _, cx, cy = views["train"].intrinsics[0].tolist()
    widest = (1 + (cx / fx) ** 2 + (cy / fx) ** 2) ** 0.5
    return Scene(
        name=root.resolve().name,
        train=views["train"],
        test=views["test"],
        near=1.0,
        far=float(bounds.max() * scale * widest),
        geometry="forward",
        background=config.background,
        exposure=config.exposure * read_light(root),
    )


def read_poses(
    source: Path,
) -> tuple[Float64[np.ndarray, "n 3 4"], Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 2"]]:
    """Camera to world with OpenGL axes, (height, width, focal length) in pixels, and the bounds.

    Raises:
        DataError: a row is no pose, or its numbers are impossible.
    """
    expected = "an array [N, 17] of finite numbers: a 3x5 matrix, near and far of each view"
    rows = map_numbers(source, expected)
    if rows.ndim != 2 or rows.shape[1] != 17 or not len(rows):
        raise DataError(source, f"an array {list(rows.shape)}", expected)
    rows = np.array(rows, dtype=np.float64)
    if not np.isfinite(rows).all():
        raise DataError(source, "NaN or infinity", expected)
    matrix, bounds = rows[:, :15].reshape(-1, 3, 5), rows[:, 15:]
    down, right, back, eye, hwf = np.moveaxis(matrix, -1, 0)
    c2w = np.stack([right, -down, back, eye], axis=-1)
    for index, pose in enumerate(c2w):
        check_rotation(pose[:, :3], source, f"row {index}")
        if np.abs(eye[index]).max() > MAX_COORDINATE:
            raise DataError(source, f"row {index} with a camera at {eye[index].tolist()}", f"below {MAX_COORDINATE:g}")
        if not (hwf[index] > 0).all():
            raise DataError(
                source, f"row {index} with height, width, focal length {hwf[index].tolist()}", "numbers > 0"
            )
        near, far = bounds[index]
        if not 0 < near < far <= MAX_COORDINATE:
            raise DataError(source, f"row {index} with bounds {near:g} and {far:g}", "0 < near < far")
    return c2w, hwf, bounds


def find_images(root: Path, downscale: int) -> tuple[list[Path], bool]:
    """The pictures in the order of their names, and whether they are yet to be shrunk by ``downscale``.

    Raises:
        DataError: there are none.
    """
    ready = root / f"images_{downscale}"
    folder = ready if downscale > 1 and ready.is_dir() else root / "images"
    if not folder.is_dir():
        there = sorted(path.name for path in root.glob("images*") if path.is_dir())
        found = f"{', '.join(there)} alone" if there else "no folder of pictures"
        raise DataError(root, found, f"images or images_{downscale} (dataset.downscale={downscale})")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)
    if not paths:
        raise DataError(folder, "no pictures", f"files ending in {', '.join(IMAGE_SUFFIXES)}")
    return paths, folder != ready


def intrinsics(hwf: Float64[np.ndarray, 3], height: int, width: int, source: Path) -> tuple[float, float, float, float]:
    """(fx, fy, cx, cy) of pictures that were shrunk from the size that the poses are for.

    Raises:
        DataError: the pictures' sides have another ratio.
    """
    full_height, full_width, focal = hwf.tolist()
    if abs(width / full_width * full_height / height - 1) > 0.02:
        found = f"poses of pictures of {full_width:g}x{full_height:g}"
        raise DataError(source, found, f"the ratio of the pictures that are there, {width}x{height}")
    return (focal * width / full_width, focal * height / full_height, 0.5 * width, 0.5 * height)


def read_depths(root: Path, pictures: list[Path], scale: float, factor: int, height: int, width: int):
    """``[N, H, W]`` distances along the rays in the scene's units, or ``None`` where there is no folder ``depth``."""
    folder = root / "depth"
    if not folder.is_dir():
        return None
    paths = []
    for picture in pictures:
        found = [path for suffix in (".npy", ".png") if (path := folder / f"{picture.stem}{suffix}").is_file()]
        if not found:
            raise DataError(folder / picture.stem, "no depth", "a .npy or .png, or no folder depth at all")
        paths.append(found[0])
    return develop_depth(paths, read_depth_scale(root) * scale, factor, height, width)
