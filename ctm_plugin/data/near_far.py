"""Near and far along the rays: from settings or files, else from points that cameras see, else from the cameras."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64

from ctm_plugin.data.capture import Capture
from ctm_plugin.data.points import Cloud
from ctm_plugin.data.settings import BoundsConfig
from ctm_plugin.errors import DataError
from ctm_plugin.scene.frustum import projected, widest
from ctm_plugin.scene.kinds import Geometry
from ctm_plugin.scene.poses import MAX_COORDINATE, meeting_depths
from ctm_plugin.scene.views import Views
from ctm_plugin.settings.setting import Number

DEPTH_PERCENTILES = (0.5, 99.5)
"""Percentiles of the depths of all cameras together that are the bounds: a few bad points are left out."""
CAMERA_PERCENTILES = (5.0, 95.0)
"""Percentiles of one camera's depths, which the bounds hold too: a close-up among many pictures is not cut."""
MIN_CAMERA_POINTS = 20
"""Least number of points of a camera whose own percentiles count."""
MIN_TRACK = 3
"""Least number of pictures that observe a point, where there are such points: two rays can meet by mistake."""
NEAR_DEPTHS, FAR_DEPTHS = 0.5, {"bounded": 2.0, "forward": 10.0, "unbounded": 10.0}
"""Bounds without points, as multiples of the least and largest depth at which the cameras' axes meet. A bounded scene's
far is smaller, as its voxels cost."""
NEAR_SPREADS, FAR_SPREADS = 0.1, 10.0
"""Bounds where axes do not meet, in largest distances between cameras."""
OUTLIER_FAR = 5.0
"""Ratio of a far to the median of all fars above which it comes from bad points."""
NEAR_MARGIN = 0.9
"""Share of the nearest depth at which rays start where no near plane is set: percentiles leave a few points out."""
NEAR, FAR = 2.0, 6.0
"""Synthetic-NeRF's bounds, for files that do not give their own."""
OBJECT_RADIUS = 1.0
"""Radius of the ball round the point where the cameras' axes meet that these bounds must enclose."""
UNTOLD, SET = "no near and far there", "dataset.near and dataset.far set them"


def near_far(capture: Capture, config: BoundsConfig, views: Sequence[Views]) -> tuple[float, float]:
    """Choose near and far: of the configuration, else of the first file that has them, else :func:`found_bounds`.

    Raises a DataError unless near < far.
    """
    near, far = (configured_bound(capture, config, key) for key in ("near", "far"))
    if near is None or far is None:
        bounds = found_bounds(capture, config.geometry, views)
        near, far = bounds[0] if near is None else near, bounds[1] if far is None else far
    if near >= far:
        source = (capture.lacking or [capture.source])[0]
        raise DataError(source, f"near {near:g}, far {far:g}", "near < far (dataset.near, dataset.far)")
    return near, far


def configured_bound(capture: Capture, config: BoundsConfig, key: str) -> float | None:
    """Near or far of the configuration, else of the first file that has it."""
    if (own := getattr(config, key)) is not None:
        return float(own)
    owner = next((record for record in capture.records if key in record), None)
    return owner and owner.number(key, is_bound, "a distance >= 0 in scene units")


def nearest(capture: Capture, config: BoundsConfig) -> float | None:
    """Find the nearest depth by the data set's files or their points, without pixels; ``None``: they give none."""
    if (near := configured_bound(capture, config, "near")) is not None:
        return near
    if capture.rows is not None:
        return float(np.nanmin(capture.rows))  # NaN: rows of pictures that see no points
    for read in capture.clouds:
        with suppress(DataError):
            cloud, _ = read()
            if cloud is not None and (bounds := bounds_of(cloud, ())) is not None:
                return bounds[0]
    return None


def found_bounds(capture: Capture, geometry: Geometry, views: Sequence[Views]) -> tuple[float, float]:
    """Find near and far that are not given: from the file's rows, from points that pictures see, or from the cameras.

    A warning tells of guesses, and of points that belong to other files.
    """
    if capture.synthetic:
        return usual_bounds(capture, geometry)
    if capture.rows is not None:
        return ray_bounds(*joint_bounds(capture, geometry), geometry, views[0])
    remarks = ""
    for read in capture.clouds:
        cloud, remark = read()
        if cloud is not None and (bounds := bounds_of(cloud, views)) is not None:
            near, far = ray_bounds(*bounds, geometry, views[0])
            if capture.lacking is None:
                warning = f"{near:.3g} and {far:.3g} are taken from the points of {cloud.name}{remarks}"
                warnings.warn(f"{capture.source}: {UNTOLD}; {warning}: {SET}", stacklevel=2)
            return near, far
        remark = remark if cloud is None else f"{cloud.name} has no points that the pictures see"
        remarks += f" ({remark})" if remark and capture.lacking is None else ""
    return bounds_of_cameras(capture, geometry, *(capture.lacking or (capture.source, UNTOLD)), remarks)


def ray_bounds(nearest: float, farthest: float, geometry: Geometry, views: Views) -> tuple[float, float]:
    """Turn bounds of depth along the cameras' axes into bounds of distance along the rays, for the views' widest ray.

    ``forward`` keeps the nearest as it is: :func:`~ctm_plugin.data.load.to_ndc_frame` has its own margin.
    """
    return nearest * (1.0 if geometry == "forward" else NEAR_MARGIN), farthest * widest(views)


def depth_bounds(depths: Sequence[Float64[np.ndarray, " _"]]) -> tuple[float, float] | None:
    """Find the nearest and farthest depth of points, given one array a camera; ``None`` where no camera sees any.

    Percentiles over all cameras' points, widened to those of each camera that sees ``MIN_CAMERA_POINTS`` of them.
    """
    depths = [each[(each > 0) & (each <= MAX_COORDINATE)] for each in depths]
    if not any(len(each) for each in depths):
        return None
    rows = [np.percentile(np.concatenate(depths), DEPTH_PERCENTILES)]
    rows += [np.percentile(each, CAMERA_PERCENTILES) for each in depths if len(each) >= MIN_CAMERA_POINTS]
    near, far = np.array(rows).T
    return float(near.min()), float(far.max())


def depths_seen(cloud: Cloud) -> list[Float64[np.ndarray, " _"]]:
    """Compute the depths of the points that each of COLMAP's pictures sees, in units of the data set's poses.

    Points that fewer than ``MIN_TRACK`` of the pictures see count only where there are no others.
    """
    seen, times = np.unique(np.concatenate([np.empty(0, np.int64), *cloud.tracks]), return_counts=True)
    trusted = seen[times >= min(MIN_TRACK, times.max(initial=0))]
    depths = []
    for picture, track in zip(cloud.taken, cloud.tracks, strict=True):
        points = cloud.positions[np.intersect1d(track, trusted)]
        depths.append(cloud.world.scale * (-(points - picture.c2w[:, 3]) @ picture.c2w[:, 2]))
    return depths


def bounds_of(cloud: Cloud, views: Sequence[Views]) -> tuple[float, float] | None:
    """Find the nearest and farthest depth of a cloud's points in the pictures, by its tracks, else by projection."""
    if (bounds := depth_bounds(depths_seen(cloud))) is not None:
        return bounds
    positions = torch.from_numpy(cloud.world.moved(cloud.positions))
    shown = [projected(positions, split, view) for split in views for view in range(len(split))]
    return depth_bounds([each.depth[each.seen].numpy() for each in shown])


def camera_bounds(c2w: Float64[np.ndarray, "n 3 4"], geometry: Geometry) -> tuple[float, float] | None:
    """Guess bounds from only the cameras; ``None`` where all stand at one place.

    Half the depth, in the nearest camera, of the point where all axes meet, to twice that in the farthest, or to ten
    times where the scene is not bounded. Where they do not meet, a tenth of the largest distance between cameras to ten
    times that.
    """
    if (depths := meeting_depths(c2w)) is not None:
        return NEAR_DEPTHS * float(depths.min()), FAR_DEPTHS[geometry] * float(depths.max())
    centres = c2w[:, :, 3]
    spread = max(float(np.linalg.norm(centres - each, axis=1).max()) for each in centres)
    return (NEAR_SPREADS * spread, FAR_SPREADS * spread) if spread > 0 else None


def bounds_of_cameras(
    capture: Capture, geometry: Geometry, source: Path, missing: str, remarks: str = ""
) -> tuple[float, float]:
    """Guess near and far from only the cameras, with one warning: what ``source`` lacks, why other sources fail.

    Raises a DataError for cameras at one place.
    """
    if (bounds := camera_bounds(capture.c2w, geometry)) is None:
        raise DataError(source, f"{missing}, all cameras at one place", "some, or dataset.near and dataset.far")
    warning = "{:.3g} and {:.3g} are taken from where the cameras stand and look".format(*bounds)
    warnings.warn(f"{source}: {missing}; {warning}{remarks}: {SET}", stacklevel=2)
    return bounds


def usual_bounds(capture: Capture, geometry: Geometry) -> tuple[float, float]:
    """Synthetic-NeRF's near and far where they suit the cameras, else the cameras'; a warning tells of doubts.

    They suit where a ball of ``OBJECT_RADIUS`` round the point where the axes meet lies between them in all cameras.
    """
    depths = meeting_depths(capture.c2w)
    if depths is None:
        warning = f"near {NEAR:g} and far {FAR:g} are Synthetic-NeRF's, and the cameras do not look at one point"
        warnings.warn(f"{capture.source}: {warning}: {SET}", stacklevel=2)
    elif depths.min() < NEAR + OBJECT_RADIUS or depths.max() > FAR - OBJECT_RADIUS:
        middle = float(np.median(depths))
        missing = f"near {NEAR:g} and far {FAR:g} do not suit cameras {middle:.3g} away from where they look"
        return bounds_of_cameras(capture, geometry, capture.source, missing)
    return NEAR, FAR


def joint_bounds(capture: Capture, geometry: Geometry) -> tuple[float, float]:
    """Nearest and farthest depth of all rows of the capture; one warning tells of rows that are left out.

    Rows of NaN belong to pictures that see no points. A far above ``OUTLIER_FAR`` medians comes from a few bad points
    and would spoil a box; NDC has room for it.
    """
    bounds = capture.rows
    seen = ~np.isnan(bounds[:, 0])
    stray = seen & (bounds[:, 1] > OUTLIER_FAR * np.median(bounds[seen, 1])) & (geometry != "forward")
    if not (seen & ~stray).all():
        rows = ", ".join(map(str, np.flatnonzero(~seen | stray)[:10]))
        warning = f"they have no points, or a far beyond {OUTLIER_FAR:g} times the others'"
        warnings.warn(f"{capture.source}: the bounds of rows {rows} are left out: {warning}: {SET}", stacklevel=2)
    near, far = bounds[seen & ~stray].T
    return float(near.min()), float(far.max())


def is_bound(value: Number) -> bool:
    """Whether a number can be a near or far bound, from 0 to ``MAX_COORDINATE``."""
    return 0 <= value <= MAX_COORDINATE
