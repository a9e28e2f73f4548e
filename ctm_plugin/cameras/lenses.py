"""Lenses of pictures without EXIF, separated by the focal length that fits each picture best."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float64

from ctm_plugin.cameras.colmap import FILM_DIAGONAL, Reconstruction, adjust, require_pycolmap
from ctm_plugin.data.readers.picture import Header

MIN_RATIO = 1.15
"""Least ratio of two lenses' focal lengths. Measured: one lens's are within 1.04, in noise 1.25 without a gap."""
MAX_SPREAD = 0.25
"""Largest spread of one lens's focal lengths, as a share of the distance between two lenses, in logarithms."""
MIN_PICTURES_OF_A_LENS = 3
TOLERANCE = 1e-4
"""Relative change of the error that ends the adjustment. Measured: 1e-3 moves two lenses too little, 1e-5 no more."""


def tell_lenses_apart(model: Reconstruction, silent: Collection[int], threads: int) -> dict[int, float]:
    """Find each lens's focal length in pixels, where pictures of one size without one in EXIF have several lenses.

    In a copy of the model each picture whose number is in ``silent`` gets its own camera, to be adjusted.

    Returns:
        The median focal length of a picture's lens, by picture number; empty where all have one lens.
    """
    own = {view: model.image(view).camera for view in model.reg_image_ids()}
    alone = {view: _copied(own[view], max(model.cameras) + 1 + view) for view in own if view in silent}
    if not alone:
        return {}
    apart = with_cameras(model, own | alone)
    adjust(apart, threads, tolerance=TOLERANCE)
    focal = {view: apart.image(view).camera.mean_focal_length() for view in alone}
    found = {}
    for shared in {own[view].camera_id for view in alone}:
        views = [view for view in alone if own[view].camera_id == shared]
        groups = lenses(np.array([focal[view] for view in views]))
        for group in groups if len(groups) > 1 else []:
            members = [views[index] for index in group]
            found |= dict.fromkeys(members, float(np.median([focal[view] for view in members])))
    return found


def with_focal_length(header: Header, focal: float | None) -> Header:
    """Copy a header, with a focal length in pixels as if by EXIF; ``None``: with its own."""
    if focal is None:
        return header
    film = focal * FILM_DIAGONAL / math.hypot(header.height, header.width)
    return header._replace(lens=header.lens._replace(film=film))


def lenses(focal: Float64[np.ndarray, " n"]) -> list[list[int]]:
    """Group pictures by lens, as lists of indices, by their focal lengths ``[N]`` in pixels; one list where no lens
    stands clearly apart.
    """
    order = np.argsort(focal)
    logs = np.log(focal[order])
    steps = np.diff(logs)
    groups = np.split(np.arange(len(focal)), np.flatnonzero(steps > np.log(MIN_RATIO)) + 1)
    far = min(steps[steps > np.log(MIN_RATIO)], default=0.0)
    clear = all(len(group) >= MIN_PICTURES_OF_A_LENS and np.ptp(logs[group]) < MAX_SPREAD * far for group in groups)
    return [order[group].tolist() for group in groups] if clear else [order.tolist()]


def with_cameras(model: Reconstruction, cameras: Mapping[int, Any]) -> Reconstruction:
    """Copy a model, with these ``cameras`` for the pictures of these numbers."""
    colmap = require_pycolmap()
    copy = colmap.Reconstruction()
    for camera in {camera.camera_id: camera for camera in cameras.values()}.values():
        copy.add_camera_with_trivial_rig(camera)
    for view, camera in sorted(cameras.items()):
        here = model.image(view)
        image = colmap.Image(name=here.name, camera_id=camera.camera_id, image_id=view)
        image.points2D = colmap.Point2DList([colmap.Point2D(each.xy) for each in here.points2D])
        copy.add_image_with_trivial_frame(image, here.cam_from_world())
    for point in model.points3D.values():
        copy.add_point3D(point.xyz, point.track)
    return copy


def _copied(camera: Any, number: int) -> Any:
    copy = require_pycolmap().Camera.create_from_model_name(
        number, camera.model.name, camera.mean_focal_length(), camera.width, camera.height
    )
    copy.params = camera.params
    return copy
