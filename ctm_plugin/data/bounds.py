"""Near and far where nobody gives them: out of points that cameras see, else out of where the cameras look."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float64

from ctm_plugin.data.geometry import ray_bounds
from ctm_plugin.data.readers.colmap_model import Taken, model_file, read_cameras, read_images, read_points
from ctm_plugin.data.readers.folders import inside
from ctm_plugin.data.readers.layouts import model_folder
from ctm_plugin.data.readers.ply import read_ply
from ctm_plugin.data.readers.records import Record
from ctm_plugin.errors import DataError
from ctm_plugin.scene.poses import MAX_COORDINATE, meeting_depths, similarity
from ctm_plugin.scene.views import Geometry, Views

ALL = (0.5, 99.5)
"""Percentiles of all depths that all cameras see: what a few bad points claim is left out."""
EACH = (5.0, 95.0)
"""Percentiles of what one camera sees, which the bounds hold too: a close-up among many pictures is not cut."""
CROWD = 20
"""Points of a camera of which the percentiles of its own are taken."""
PICTURES = 3
"""Pictures that see a point, at least, where there are such points: two rays meet anywhere by mistake."""
NEAREST, FARTHEST = 0.5, {"bounded": 2.0, "forward": 10.0, "unbounded": 10.0}
"""Bounds without points, in depths of where the cameras' axes meet, of the nearest camera and of the farthest: only
between the cameras and a bounded scene's far do voxels cost."""
CLOSE, WIDE = 0.1, 10.0
"""Bounds where axes do not meet, in largest distances between cameras."""
OFF, TURNED = 0.01, 0.0175
"""How far cameras of two files may be apart to be the same: a part of their spread, and one degree."""
Poses = Sequence[tuple[str, Float64[np.ndarray, "3 4"]]]
"""Pictures' names and their cameras, camera to world."""
Found = tuple[tuple[float, float] | None, str, str]
"""Bounds of depths, where they are from, and why there are none."""


def depth_bounds(depths: Sequence[Float64[np.ndarray, " _"]]) -> tuple[float, float] | None:
    """Find the nearest and farthest of the depths of points, one list a camera.

    Percentiles over all cameras' points, widened to those of each camera that sees enough of them.

    Returns:
        ``None`` where no camera sees any.
    """
    depths = [each[(each > 0) & (each <= MAX_COORDINATE)] for each in depths]
    if not any(len(each) for each in depths):
        return None
    rows = [np.percentile(np.concatenate(depths), ALL)]
    rows += [np.percentile(each, EACH) for each in depths if len(each) >= CROWD]
    near, far = np.array(rows).T
    return float(near.min()), float(far.max())


def depths_seen(taken: Sequence[Taken], path: Path) -> list[Float64[np.ndarray, " _"]]:
    """Read the depths, for each picture, of the points that it sees, out of COLMAP's ``points3D.bin``.

    Points that fewer than ``PICTURES`` of the pictures see count only where there are no others.

    Raises:
        DataError: the points cannot be read.
    """
    numbers, positions = read_points(path)
    tracks = [np.intersect1d(picture.points, numbers) for picture in taken]
    seen, times = np.unique(np.concatenate([np.empty(0, np.int64), *tracks]), return_counts=True)
    trusted = seen[times >= min(PICTURES, times.max(initial=0))]
    depths = []
    for picture, track in zip(taken, tracks, strict=True):
        points = positions[np.searchsorted(numbers, np.intersect1d(track, trusted))]
        depths.append(-(points - picture.c2w[:, 3]) @ picture.c2w[:, 2])
    return depths


def depths_in_view(points: Float64[np.ndarray, "p 3"], views: Views) -> list[Float64[np.ndarray, " _"]]:
    """Compute the depths, for each view, of the points that project into it, through a lens without distortion."""
    depths = []
    for c2w, (fx, fy, cx, cy) in zip(views.c2w.double().numpy(), views.intrinsics.double().numpy(), strict=True):
        x, y, z = ((points - c2w[:, 3]) @ c2w[:, :3]).T
        ahead = z < 0
        depth = np.where(ahead, -z, 1.0)
        column, row = cx + fx * x / depth, cy - fy * y / depth
        inside = (column >= 0) & (column <= views.width) & (row >= 0) & (row <= views.height)
        depths.append(depth[ahead & inside])
    return depths


def camera_bounds(c2w: Float64[np.ndarray, "n 3 4"], geometry: Geometry) -> tuple[float, float] | None:
    """Guess bounds from the cameras alone.

    Half the depth, in the nearest camera, of the point where all axes meet, to twice that in the farthest, or to ten
    times where the scene is not bounded. Where they do not meet, a tenth of the largest distance between cameras to ten
    times that.

    Returns:
        ``None`` where all stand at one place.
    """
    if (depths := meeting_depths(c2w)) is not None:
        return NEAREST * float(depths.min()), FARTHEST[geometry] * float(depths.max())
    centres = c2w[:, :, 3]
    spread = max(float(np.linalg.norm(centres - each, axis=1).max()) for each in centres)
    return (CLOSE * spread, WIDE * spread) if spread > 0 else None


def bounds_of_cameras(
    source: Path, c2w: Float64[np.ndarray, "n 3 4"], geometry: Geometry, missing: str, remarks: str = ""
) -> tuple[float, float]:
    """Guess near and far from the cameras alone, told in one warning.

    Args:
        source: the file that should have them.
        c2w: the cameras.
        geometry: of the scene to be.
        missing: what ``source`` lacks.
        remarks: why other sources are of no use.

    Raises:
        DataError: all cameras stand at one place.
    """
    if (found := camera_bounds(c2w, geometry)) is None:
        raise DataError(source, f"{missing}, all cameras at one place", "some, or dataset.near and dataset.far")
    near, far = found
    warnings.warn(
        f"{source}: {missing}; {near:.3g} and {far:.3g} are taken from where the cameras stand and look alone"
        f"{remarks}: dataset.near and dataset.far set them",
        stacklevel=2,
    )
    return near, far


def derived_bounds(
    root: Path, record: Record, poses: Poses, views: Sequence[Views], geometry: Geometry
) -> tuple[float, float]:
    """Find near and far along the rays for a file that has none, told in one warning.

    From the points of COLMAP's model beside it, where that has the same cameras up to a similarity; else from those of
    ``ply_file_path``; else from the cameras alone.

    Args:
        root: the data set's folder.
        record: the file; ``ply_file_path`` names points in the world of its poses.
        poses: the pictures' names in the file and their cameras.
        views: of training and of testing.
        geometry: of the scene to be.

    Raises:
        DataError: the file of points that it names is damaged, or all cameras stand at one place.
    """
    found, source, remarks = None, "", []
    for points in (of_model, of_ply):
        if found is None:
            found, source, remark = points(root, record, poses, views)
            remarks += [remark] if remark else []
    missing, why = "no near and far there", "".join(f" ({remark})" for remark in remarks)
    if found is None:
        return bounds_of_cameras(record.source, np.stack([pose for _, pose in poses]), geometry, missing, why)
    near, far = ray_bounds(*found, geometry, views[0])
    warnings.warn(
        f"{record.source}: {missing}; {near:.3g} and {far:.3g} are taken {source}{why}: "
        "dataset.near and dataset.far set them",
        stacklevel=2,
    )
    return near, far


def of_model(root: Path, record: Record, poses: Poses, views: Sequence[Views]) -> Found:
    """Find bounds from COLMAP's model beside the file, whose world is another."""
    folder = model_folder(root)
    if folder is None:
        return None, "", ""
    name = folder.relative_to(root)
    try:
        taken = read_images(model_file(folder, "images"), read_cameras(model_file(folder, "cameras")))
        ours = {PurePosixPath(each).stem: pose for each, pose in poses}
        same = [picture for picture in taken if PurePosixPath(picture.name).stem in ours]
        if len(same) < PICTURES:
            return None, "", f"{name} has {len(same)} of the pictures"
        moved = similarity(
            np.stack([picture.c2w for picture in same]),
            np.stack([ours[PurePosixPath(picture.name).stem] for picture in same]),
        )
        if moved.off > OFF or moved.angle > TURNED:
            off = f"{100 * moved.off:.2g} % of their spread and {np.degrees(moved.angle):.2g} degrees off"
            return None, "", f"the cameras of {name} are others, {off}"
        depths = depths_seen(same, model_file(folder, "points3D"))
    except DataError as error:
        return None, "", f"{name} is of no use: {error}"
    found = depth_bounds([moved.scale * each for each in depths])
    return found, f"from the points of {name}", "" if found else f"{name} has no points that the pictures see"


def of_ply(root: Path, record: Record, poses: Poses, views: Sequence[Views]) -> Found:
    """Find bounds from the points that the file names, in its own world.

    Raises:
        DataError: they are damaged.
    """
    if not record.values.get("ply_file_path"):
        return None, "", ""
    name = record.text("ply_file_path", "the path of a PLY file")
    path = inside(root, name, record.source)
    if not path.is_file():
        return None, "", f"{name} is not there"
    points = read_ply(path)
    found = depth_bounds([each for split in views for each in depths_in_view(points, split)])
    return found, f"from the points of {name}", "" if found else f"{name} has no points that the pictures see"
