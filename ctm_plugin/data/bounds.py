"""Near and far where nobody gives them: out of points that cameras see, else out of where the cameras look."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from ctm_plugin.data.geometry import ray_bounds
from ctm_plugin.data.points import Cloud, Found, Poses
from ctm_plugin.errors import DataError
from ctm_plugin.scene.poses import MAX_COORDINATE, meeting_depths
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


def depths_seen(cloud: Cloud) -> list[Float64[np.ndarray, " _"]]:
    """Compute the depths, in units of the data set's poses, for each picture of COLMAP's, of the points that it sees.

    Points that fewer than ``PICTURES`` of the pictures see count only where there are no others.
    """
    seen, times = np.unique(np.concatenate([np.empty(0, np.int64), *cloud.tracks]), return_counts=True)
    trusted = seen[times >= min(PICTURES, times.max(initial=0))]
    depths = []
    for picture, track in zip(cloud.taken, cloud.tracks, strict=True):
        points = cloud.positions[np.intersect1d(track, trusted)]
        depths.append(cloud.world.scale * (-(points - picture.c2w[:, 3]) @ picture.c2w[:, 2]))
    return depths


def depths_in_view(points: Float64[np.ndarray, "p 3"], views: Views) -> list[Float64[np.ndarray, " _"]]:
    """Compute the depths, for each view, of the points that project into it, through a lens without distortion."""
    depths = []
    parts = views.c2w.double().numpy(), views.intrinsics.double().numpy(), views.extents.numpy()
    for c2w, (fx, fy, cx, cy), (width, height) in zip(*parts, strict=True):
        x, y, z = ((points - c2w[:, 3]) @ c2w[:, :3]).T
        ahead = z < 0
        depth = np.where(ahead, -z, 1.0)
        column, row = cx + fx * x / depth, cy - fy * y / depth
        inside = (column >= 0) & (column <= width) & (row >= 0) & (row <= height)
        depths.append(depth[ahead & inside])
    return depths


def bounds_of(cloud: Cloud, views: Sequence[Views]) -> tuple[float, float] | None:
    """Find the nearest and farthest depths of the points that pictures see, or that views show where nobody tells.

    Returns:
        ``None`` where no camera sees any.
    """
    if (found := depth_bounds(depths_seen(cloud))) is not None:
        return found
    positions = cloud.world.moved(cloud.positions)
    return depth_bounds([each for split in views for each in depths_in_view(positions, split)])


def camera_bounds(c2w: Float64[np.ndarray, "n 3 4"], geometry: Geometry) -> tuple[float, float] | None:
    """Guess bounds from only the cameras.

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
    """Guess near and far from only the cameras, with one warning.

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
        f"{source}: {missing}; {near:.3g} and {far:.3g} are taken from where the cameras stand and look"
        f"{remarks}: dataset.near and dataset.far set them",
        stacklevel=2,
    )
    return near, far


def derived_bounds(
    source: Path, poses: Poses, views: Sequence[Views], geometry: Geometry, clouds: Sequence[Callable[[], Found]]
) -> tuple[float, float]:
    """Find near and far along the rays for a file that has none, with one warning.

    From the first points that pictures see, else from the cameras.

    Args:
        source: the file.
        poses: the pictures' names in the file and their cameras.
        views: of training and of testing.
        geometry: of the scene to be.
        clouds: find points, the best first.

    Raises:
        DataError: a file of points that the file names is damaged, or all cameras stand at one place.
    """
    found, used, remarks = None, "", []
    for read in clouds:
        if found is None:
            cloud, remark = read()
            if cloud is not None:
                found = bounds_of(cloud, views)
                used, remark = cloud.name, "" if found else f"{cloud.name} has no points that the pictures see"
            remarks += [remark] if remark else []
    missing, why = "no near and far there", "".join(f" ({remark})" for remark in remarks)
    if found is None:
        return bounds_of_cameras(source, np.stack([pose for _, pose in poses]), geometry, missing, why)
    near, far = ray_bounds(*found, geometry, views[0])
    warnings.warn(
        f"{source}: {missing}; {near:.3g} and {far:.3g} are taken from the points of {used}{why}: "
        "dataset.near and dataset.far set them",
        stacklevel=2,
    )
    return near, far
