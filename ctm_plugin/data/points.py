"""3D points of reconstructions, and the pictures that see them: of COLMAP's models and of PLY files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float64, Int64

from ctm_plugin.data.readers.colmap_model import Taken, model_file, read_cameras, read_images, read_points, usable
from ctm_plugin.data.readers.folders import fold, inside, plain_name
from ctm_plugin.data.readers.layouts import model_folder
from ctm_plugin.data.readers.ply import read_ply
from ctm_plugin.data.readers.records import Record
from ctm_plugin.errors import DataError
from ctm_plugin.scene.poses import IDENTITY, MAX_COORDINATE, Similarity, similarity
from ctm_plugin.scene.views import Points

MIN_SHARED = 3
"""Least number of pictures that two files must share for their cameras to be compared."""
MIN_VIEWS = 2
"""Least number of training pictures that observe a point, where there are such points: others are less certain."""
MAX_OFFSET, MAX_ANGLE = 0.01, 0.0175
"""Largest difference of two files' cameras that count as the same: a share of their spread, and one degree in
radians."""
Poses = Sequence[tuple[str, Float64[np.ndarray, "3 4"]]]
"""Names of pictures with their cameras, camera to world."""


class Cloud(NamedTuple):
    """A reconstruction's 3D points, in its own world.

    Attributes:
        name: where the points are from, for messages.
        positions: ``[P, 3]``.
        world: similarity from the points' world to that of the data set's poses.
        taken: pictures of the reconstruction; empty where it is unknown which see the points.
        tracks: for each picture the rows of the points that it sees, each once.
    """

    name: str
    positions: Float64[np.ndarray, "p 3"]
    world: Similarity = IDENTITY
    taken: Sequence[Taken] = ()
    tracks: Sequence[Int64[np.ndarray, " _"]] = ()


PointsOrReason = tuple[Cloud | None, str]
"""A cloud of points and an empty reason, or ``None`` and why there is none."""


def read_cloud(name: str, taken: Sequence[Taken], path: Path, world: Similarity = IDENTITY) -> Cloud:
    """Read COLMAP's ``points3D.bin``, with the tracks of these pictures."""
    numbers, positions = read_points(path)
    seen = [np.unique(picture.points) for picture in taken]
    tracks = [np.searchsorted(numbers, each[np.isin(each, numbers)]) for each in seen]
    return Cloud(name, positions, world, taken, tracks)


def model_beside(root: Path, poses: Poses) -> PointsOrReason:
    """Find the points of a COLMAP model next to other files, if its cameras equal the files' up to a similarity."""
    folder = model_folder(root)
    if folder is None:
        return None, ""
    name = str(folder.relative_to(root))
    try:
        taken = usable(read_images(model_file(folder, "images"), read_cameras(model_file(folder, "cameras"))))
        ours = dict(poses)
        names = paired([each.name for each in taken], list(ours))
        same = [each._replace(name=names[each.name]) for each in taken if each.name in names]
        if len(same) < MIN_SHARED:
            return None, f"{name} has {len(same)} of the pictures"
        world = similarity(np.stack([each.c2w for each in same]), np.stack([ours[each.name] for each in same]))
        if world.off > MAX_OFFSET or world.angle > MAX_ANGLE:
            off = f"{100 * world.off:.2g} % of their spread and {np.degrees(world.angle):.2g} degrees off"
            return None, f"the cameras of {name} are others, {off}"
        return read_cloud(name, same, model_file(folder, "points3D"), world), ""
    except DataError as error:
        return None, f"{name} is of no use: {error}"


def paired(theirs: Sequence[str], ours: Sequence[str]) -> dict[str, str]:
    """Pair pictures of two files by an ending of their paths that is unique in both; suffixes and case aside."""

    def alone(names: Sequence[str]) -> dict[tuple[str, ...], str]:
        ends: dict[tuple[str, ...], list[str]] = {}
        for name in names:
            path = PurePosixPath(fold(plain_name(name)))
            parts = (*path.parent.parts, path.stem)
            for start in range(len(parts)):
                ends.setdefault(parts[start:], []).append(name)
        return {end: each[0] for end, each in ends.items() if len(each) == 1}

    ends = alone(ours)
    return {name: ends[end] for end, name in alone(theirs).items() if end in ends}


def ply_named(root: Path, record: Record) -> PointsOrReason:
    """Find the points of the ``ply_file_path`` that a file names, in the world of its poses."""
    if not record.values.get("ply_file_path"):
        return None, ""
    name = record.text("ply_file_path", "the path of a PLY file")
    path = inside(root, name, record.source)
    return (Cloud(name, read_ply(path)), "") if path.is_file() else (None, f"{name} is not there")


def points_of(cloud: Cloud, names: Sequence[str]) -> Points | None:
    """Points in the world of the data set's poses, of which ``MIN_VIEWS`` training views, called ``names``, see each.

    Where no point has so many, one view will do. Points beyond ``MAX_COORDINATE`` are left out; ``None``: none is left.
    """
    tracks = {picture.name: track for picture, track in zip(cloud.taken, cloud.tracks, strict=True)}
    seen = [tracks.get(name, np.empty(0, np.int64)) for name in names]
    point, view = np.concatenate(seen), np.repeat(np.arange(len(names)), [len(each) for each in seen])
    positions = cloud.world.moved(cloud.positions)
    times = np.bincount(point, minlength=len(positions))
    kept = (times >= min(MIN_VIEWS, times.max(initial=0))) & (np.abs(positions) <= MAX_COORDINATE).all(1)
    row, there = np.cumsum(kept) - 1, kept[point]
    parts = (positions[kept].astype(np.float32), row[point[there]], view[there])
    return Points(*map(torch.from_numpy, parts)) if kept.any() else None


def first_points(names: Sequence[str], *reads: Callable[[], PointsOrReason]) -> Points | None:
    """Take the first cloud that exists and can be read, see :func:`points_of`; ``None`` where there is none."""
    for read in reads:
        with suppress(DataError):  # no scene needs points: what does has read them before
            cloud, _ = read()
            if cloud is not None and (points := points_of(cloud, names)) is not None:
                return points
    return None
