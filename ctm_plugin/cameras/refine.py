"""Refinement of a model's observations below a pixel, by aligning each picture's patch with the mean of all others'."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from ctm_plugin.cameras.colmap import MIN_TRACK, Reconstruction, adjust, require_pycolmap
from ctm_plugin.show.bars import Update

BLUR = 0.15
"""Standard deviation of the Gaussian that blurs pictures, as a share of a patch's reach."""
STEPS = 2
"""Gauss-Newton steps of each patch before cameras are adjusted."""
MAX_STEP, MAX_MOVE = 1.5, 4.0
"""Pixels that a patch may move in a step, and in all from its point's projection; the latter is COLMAP's bound."""
MIN_ANGLE = 1.5
"""Least degrees between two rays to a point; COLMAP's own bound."""
MAX_DOUBT = 0.5
"""Largest standard deviation in pixels, by the noise, of a patch's position that is used."""


class PatchObservations(NamedTuple):
    """Observations of points in one picture, and the patches round them.

    Attributes:
        rows: ``[O]`` rows of the observed points.
        indices: ``[O]`` their indices among the picture's keypoints.
        middles: ``[O, 2]`` column and row of the points' projections, in pixels.
        axes: ``[O, 2, 2]`` steps in this picture for a pixel right and a pixel down in the point's reference picture.
    """

    rows: Int64[Tensor, " o"]
    indices: list[int]
    middles: Float32[Tensor, "o 2"]
    axes: Float32[Tensor, "o 2 2"]


class Luminance(NamedTuple):
    """A picture's downscaled luminance, in which keypoints and patches are searched.

    Attributes:
        light: ``[H, W]`` linear light of any unit, sides ``scale`` times smaller than the whole picture's.
        scale: a whole number >= 1.
    """

    light: Float32[Tensor, "h w"]
    scale: int


def refine(
    model: Reconstruction, lights: Sequence[Luminance], reach: int, rounds: int, threads: int, done: Update
) -> None:
    """Refine observations until the pictures' patches agree, then adjust cameras and points, for several rounds.

    For picture i and a point, ``sum w (P_i(x + d) - mean_{j != i} P_j(x))^2`` over a patch is made small by steps of
    Gauss and Newton on d (B. Lucas and T. Kanade, IJCAI 1981). Leaving i out keeps its noise out of the mean, which
    has that of many pictures averaged; patches are parallel to one of the pictures.

    Args:
        model: COLMAP's model, changed in place. Pictures are numbered from 1.
        lights: luminance of all pictures; each is divided by its mean, so that exposures may differ.
        reach: pixels from the middle of a patch to its side; more for more noise, less where surfaces are not flat.
        rounds: number of rounds.
        threads: number of CPU threads; -1: all.
        done: called with the number of rounds done.
    """
    colmap = require_pycolmap()
    for point in [number for number, each in model.points3D.items() if each.track.length() < MIN_TRACK]:
        model.delete_point3D(point)
    even, scales = {}, {}
    for view in model.reg_image_ids():
        light, scales[view] = lights[view - 1]
        even[view] = blurred(light / light.mean().clamp(min=1e-12), BLUR * reach)
    for number in range(rounds):
        numbers = [*model.points3D]
        for view, (sights, places, good) in moved(sights_of(model, numbers, scales), even, reach).items():
            for row, index, place, kept in zip(sights.rows.tolist(), sights.indices, places, good, strict=True):
                if kept:
                    model.image(view).points2D[index].xy = place * scales[view]
                elif model.exists_point3D(numbers[row]):
                    model.delete_observation(view, index)
        adjust(model, threads)
        colmap.ObservationManager(model).filter_all_points3D(MAX_MOVE * max(scales.values()), MIN_ANGLE)
        done(number + 1)
    model.update_point_3d_errors()


def sights_of(model: Reconstruction, numbers: Sequence[int], scales: Mapping[int, int]) -> dict[int, PatchObservations]:
    """Project the points of these ``numbers`` into each picture, in pixels of pictures downscaled by ``scales``."""
    poses = {view: model.image(view).cam_from_world().matrix() for view in model.reg_image_ids()}
    focal = {view: model.image(view).camera.mean_focal_length() / scales[view] for view in poses}
    seen: dict[int, list[tuple[int, int]]] = defaultdict(list)
    corners = np.empty((len(numbers), 3, 3))
    for row, number in enumerate(numbers):
        point = model.points3D[number]
        pixels = {}
        for each in point.track.elements:
            seen[each.image_id].append((row, each.point2D_idx))
            pixels[each.image_id] = (poses[each.image_id][2] @ [*point.xyz, 1]) / focal[each.image_id]
        own = sorted(pixels, key=pixels.get)[len(pixels) // 2]  # neither the nearest nor the farthest
        corners[row] = point.xyz + np.stack([np.zeros(3), *poses[own][:2, :3]]) * pixels[own]
    found = {}
    for view, sights in seen.items():
        rows, indices = map(list, zip(*sights, strict=True))
        here = corners[rows].reshape(-1, 3) @ poses[view][:, :3].T + poses[view][:, 3]
        places = model.image(view).camera.img_from_cam(here, False).reshape(-1, 3, 2) / scales[view]
        places = torch.from_numpy(places).float()
        found[view] = PatchObservations(torch.tensor(rows), indices, places[:, 0], places[:, 1:] - places[:, :1])
    return found


@torch.no_grad()
def moved(
    seen: Mapping[int, PatchObservations], lights: Mapping[int, Float32[Tensor, "h w"]], reach: int
) -> dict[int, tuple[PatchObservations, np.ndarray, list[bool]]]:
    """Align each picture's patches: refined positions ``[O, 2]`` in pixels, and whether each can be trusted."""
    side = torch.arange(-reach, reach + 1.0)
    patch = torch.cartesian_prod(side, side).flip(-1)
    bell = torch.exp(-(patch**2).sum(-1) / (2 * (reach / 2) ** 2))
    weight = bell / bell.sum()
    count = 1 + max(int(sights.rows.max()) for sights in seen.values())
    moves = {view: torch.zeros(len(sights.rows), 2) for view, sights in seen.items()}
    inside, sure = {}, {}
    for _ in range(STEPS):
        total, times, looks = torch.zeros(count, len(patch)), torch.zeros(count), {}
        for view, sights in seen.items():
            places = (sights.middles + moves[view])[:, None] + patch @ sights.axes
            look, inside[view] = looked_up(lights[view], places)
            looks[view] = look - (look @ weight)[:, None]
            total.index_add_(0, sights.rows, looks[view] * inside[view][:, None])
            times.index_add_(0, sights.rows, inside[view].float())
        for view, sights in seen.items():
            others = (total[sights.rows] - looks[view]) / (times[sights.rows] - 1).clamp(min=1)[:, None]
            square = F.pad(others.unflatten(-1, (len(side), -1))[:, None], (1, 1, 1, 1), mode="replicate")[:, 0]
            across = square[:, 1:-1, 2:] - square[:, 1:-1, :-2]
            slope = 0.5 * torch.stack([across, square[:, 2:, 1:-1] - square[:, :-2, 1:-1]], -1).flatten(1, 2)
            slope = slope - (weight @ slope)[:, None]
            normal = (slope * weight[:, None]).mT @ slope
            normal.diagonal(dim1=-2, dim2=-1).clamp_(min=1e-12)
            rest = others - looks[view]
            doubt = (rest**2 @ weight) / (torch.linalg.eigvalsh(normal)[:, 0] * bell.sum())
            sure[view] = inside[view] & (times[sights.rows] >= MIN_TRACK) & (doubt < MAX_DOUBT**2)
            step = torch.linalg.solve_ex(normal, slope.mT @ (weight * rest)[..., None])[0]
            step = (step.mT @ sights.axes)[:, 0]  # from the point's own picture into this one
            moves[view] += step.nan_to_num().clamp(-MAX_STEP, MAX_STEP)
    return {
        view: (
            sights,
            (sights.middles + moves[view]).double().numpy(),
            (sure[view] & (moves[view].norm(dim=-1) < MAX_MOVE)).tolist(),
        )
        for view, sights in seen.items()
    }


def looked_up(
    light: Float32[Tensor, "h w"], places: Float32[Tensor, "o p 2"]
) -> tuple[Float32[Tensor, "o p"], Bool[Tensor, " o"]]:
    """Interpolate light at columns and rows in pixels, the first centre at 0.5; tell which patches are all inside."""
    height, width = light.shape
    size = torch.tensor([width, height])
    inside = ((places >= 0.5) & (places <= size - 0.5)).flatten(1).all(-1)
    return F.grid_sample(light[None, None], (places / size * 2 - 1)[None], align_corners=False)[0, 0], inside


def blurred(light: Float32[Tensor, "h w"], sigma: float) -> Float32[Tensor, "h w"]:
    """Blur light by a Gaussian of standard deviation ``sigma`` pixels."""
    far = round(4 * sigma)
    bell = torch.exp(-(torch.arange(-far, far + 1.0) ** 2) / (2 * sigma**2))
    bell /= bell.sum()
    wide = F.pad(light[None, None], (far,) * 4, mode="replicate")
    return F.conv2d(F.conv2d(wide, bell[None, None, None]), bell[None, None, :, None])[0, 0]
