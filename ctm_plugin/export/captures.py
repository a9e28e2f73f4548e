"""Export of a scene as a folder that other programs train on: pictures, masks, ``transforms.json``, COLMAP's model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import imageio.v3 as iio
import numpy as np
import tifffile
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from ctm_plugin.data.load import NEAR_TARGET
from ctm_plugin.data.readers.colmap_model import Taken
from ctm_plugin.data.readers.images import to_8_bits
from ctm_plugin.data.readers.lens import PINHOLE, Intrinsics
from ctm_plugin.data.write_colmap import write_model
from ctm_plugin.files import replacing, write_json, write_text
from ctm_plugin.scene.frustum import projected
from ctm_plugin.scene.poses import IDENTITY
from ctm_plugin.scene.views import Pixels, Points, Scene, Views, unit
from ctm_plugin.show.bars import tracked
from ctm_plugin.show.ply import write_ply

POINTS_FILE = "sparse_pc.ply"
"""Name of a second file of the points, for nerfstudio, which does not read COLMAP's."""


class Dots(NamedTuple):
    """A cloud of points in the files' world: positions and normals ``[P, 3]``, and sRGB ``[P, 3]`` of 8 bits."""

    positions: Float[np.ndarray, "p 3"]
    normals: Float[np.ndarray, "p 3"]
    colors: UInt8[np.ndarray, "p 3"]


class PointObservations(NamedTuple):
    """Points that a picture observes: their rows ``[T]``, positions in pixels ``[T, 2]``, and its colours there."""

    rows: np.ndarray
    places: np.ndarray
    colors: np.ndarray


class CapturedView(NamedTuple):
    """A view in COLMAP's or nerfstudio's list.

    Attributes:
        file: name of the view's picture in the folder ``images``.
        testing: whether it is a test view.
        lens: intrinsics and distortion.
        pose: camera to world, in the files' world.
        observed: the points that the view observes.
    """

    file: str
    testing: bool
    lens: Intrinsics
    pose: Float[np.ndarray, "3 4"]
    observed: PointObservations


NO_DOTS = Dots(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3), np.uint8))
"""A cloud without points."""
NO_OBSERVATIONS = PointObservations(np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 3), np.uint8))
"""The observations of a picture that sees no point."""


def write_capture(
    folder: Path,
    scene: Scene,
    picture: Callable[[Views, int], Pixels | None],
    dots: Dots | None = None,
    absent: bool = False,
) -> None:
    """Write a scene for other programs, with cameras and points in the files' world.

    ``images/NAME.png``, or ``.tif`` of floats; ``masks/NAME.png`` of all views where some are masked;
    ``transforms.json`` as nerfstudio has it, with which views are for testing; ``sparse/0``, COLMAP's model, with
    ``test.txt``, which names the test views as 3DGS reads it; the points as ``sparse_pc.ply``. A name of both splits
    gets the split's name before it.

    Args:
        folder: to write to.
        scene: its views, bounds and world.
        picture: gives a view's pixels, ``None`` where it has no picture.
        dots: points; ``None``: those of the scene's reconstruction that views see, with what the pictures show there.
        absent: whether views without a picture are listed too.
    """
    points = scene.points if dots is None else None
    splits = {"train": scene.train, "test": scene.test}
    twice = not set(scene.train.names).isdisjoint(scene.test.names)
    masked = any(views.mask is not None for views in splits.values())  # nerfstudio wants all masks or none
    shots: list[CapturedView] = []
    for kind in ("images", *(("masks",) if masked else ())):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    for split, views in splits.items():
        poses = (scene.world or IDENTITY).inverse().of_poses(views.c2w.double().numpy())
        for index in tracked(range(len(views)), f"{split} views"):
            image = picture(views, index)
            if image is None and not absent:
                continue
            name = f"{split}_{views.names[index]}" if twice else views.names[index]
            kind = "png" if (views.images if image is None else image).dtype == torch.uint8 else "tif"
            if image is not None:
                write_pixels(folder / f"images/{name}.{kind}", image)
            if masked:
                mask = torch.ones(views.height, views.width) if views.mask is None else views.mask[index]
                write_pixels(folder / f"masks/{name}.png", mask[..., None].to(torch.uint8) * 255)
            known = points is not None and split == "train" and image is not None
            observed = seen(points, views, index, image) if known else NO_OBSERVATIONS
            shots.append(CapturedView(f"{name}.{kind}", split == "test", lens_of(views, index), poses[index], observed))
    if dots is None:
        dots, shots = coloured(scene, shots)
    write_sparse(folder / "sparse/0", shots, dots)
    lists = {
        f"{split}_filenames": [f"images/{each.file}" for each in shots if each.testing == (split == "test")]
        for split in splits
    }
    lists["val_filenames"] = lists["test_filenames"]  # nerfstudio wants all lists or none, and these while it trains
    content = {"camera_model": "OPENCV", "w": scene.train.width, "h": scene.train.height, **bounds_of(scene), **lists}
    if len(dots.positions):
        write_ply(folder / POINTS_FILE, *dots)
        content["ply_file_path"] = POINTS_FILE
    write_json(folder / "transforms.json", {**content, "frames": [frame_of(each, masked) for each in shots]})


def write_sparse(folder: Path, shots: Sequence[CapturedView], dots: Dots) -> None:
    """Write COLMAP's model of these views and points, and which are for testing."""
    cameras = {lens: number for number, lens in enumerate(dict.fromkeys(each.lens for each in shots), 1)}
    taken = [Taken(each.file, each.pose, cameras[each.lens], each.observed.rows + 1) for each in shots]
    write_model(folder, list(cameras), taken, [each.observed.places for each in shots], dots.positions, dots.colors)
    write_text(folder / "test.txt", "".join(f"{each.file}\n" for each in shots if each.testing))


def bounds_of(scene: Scene) -> dict[str, float]:
    """Near and far of a scene, in units of the files' world."""
    size = (scene.world or IDENTITY).scale
    near = scene.near if scene.world is None else 1 / (NEAR_TARGET * size)  # what becomes NDC's near plane
    return {"near": near, "far": scene.far / size}


def lens_of(views: Views, index: int) -> Intrinsics:
    """A view's intrinsics and distortion."""
    distortion = PINHOLE if views.distortion is None else tuple(views.distortion[index].tolist())
    return Intrinsics(views.width, views.height, *views.intrinsics[index].tolist(), distortion)


def frame_of(shot: CapturedView, masked: bool) -> dict[str, Any]:
    """A view's entry among the frames of ``transforms.json``."""
    lens, name = shot.lens, Path(shot.file).stem
    numbers = dict(zip(("fl_x", "fl_y", "cx", "cy"), lens.pinhole, strict=True))
    if lens.distortion != PINHOLE:
        numbers |= dict(zip(("k1", "k2", "p1", "p2", "k3"), lens.distortion, strict=True))
    frame = {"file_path": f"images/{shot.file}", **numbers}
    if masked:
        frame["mask_path"] = f"masks/{name}.png"
    return {**frame, "transform_matrix": [*shot.pose.tolist(), [0.0, 0.0, 0.0, 1.0]]}


def seen(points: Points, views: Views, index: int, image: Pixels) -> PointObservations:
    """Observations of a training view: the points known to be in it, and its colours there."""
    rows = points.point[points.view == index]
    column, row, _, there = projected(points.positions[rows].double(), views, index)
    rows, places = rows[there], torch.stack([column, row], 1)[there]
    x, y = (at.long().clamp(0, n - 1) for at, n in zip(places.unbind(1), (views.width, views.height), strict=True))
    return PointObservations(rows.numpy(), places.numpy(), to_8_bits(unit(image[y, x, :3])).numpy())


def coloured(scene: Scene, shots: Sequence[CapturedView]) -> tuple[Dots, list[CapturedView]]:
    """The reconstruction's points that views see, in the mean of their colours, and the sights of these.

    The normals are 0, as they are unknown.
    """
    count = 0 if scene.points is None else len(scene.points.positions)
    rows, _, colors = (np.concatenate(part) for part in zip(*(each.observed for each in shots), strict=True))
    times = np.bincount(rows, minlength=count)
    kept = times > 0
    if not kept.any():
        return NO_DOTS, list(shots)
    sums = np.stack([np.bincount(rows, channel, count) for channel in colors.T.astype(float)], 1)
    positions = (scene.world or IDENTITY).inverse().moved(scene.points.positions.double().numpy()[kept])
    dots = Dots(positions, np.zeros_like(positions), (sums[kept] / times[kept, None]).round().astype(np.uint8))
    row = np.cumsum(kept) - 1
    return dots, [each._replace(observed=each.observed._replace(rows=row[each.observed.rows])) for each in shots]


def write_pixels(path: Path, image: Tensor) -> None:
    """Write a picture ``[H, W, C]``: 8 bits as PNG, floats as TIFF of 16 bits."""
    with replacing(path) as beside:
        if image.dtype == torch.uint8:
            iio.imwrite(beside, image.squeeze(-1).numpy(), extension=".png")
        else:
            tifffile.imwrite(beside, (image.numpy() * 65535).round().astype(np.uint16), photometric="rgb")
