"""Spaces in which samples lie evenly along rays: a box of the world, NDC, or all of space contracted."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.contraction import BALL_RADIUS, END_PACE, contract, distance, lengths, paced, travelled
from ctm_plugin.rays.grid import Shape, voxel_size
from ctm_plugin.rays.ndc import NDC
from ctm_plugin.rays.sampling import intersect_box
from ctm_plugin.scene.frustum import camera_ball, edge_rays, frustum_box, ndc_of, ray_box
from ctm_plugin.scene.views import Scene


class Box(nn.Module):
    """Space that is a box of the world: its rays are the world's, from ``near`` to ``far``.

    Args:
        box: ``[2, 3]``, in the space.
        near, far: distances along rays between which samples lie.
        behind: distance in the world at which light that nothing stops counts as stopped.

    Attributes:
        stride: distance between samples along rays of the space, once :meth:`divide` has set it.
        measure: unit of length along rays that optical depths are given for; the box's longest side.
        side: the box's longest side.
        longest: upper bound of a ray's length in the space.
    """

    contracted = False
    """Whether samples are at paces, and points in the ball, of :mod:`ctm_plugin.rays.contraction`."""
    stride: float

    def __init__(self, box: Tensor, near: float, far: float, behind: float):
        super().__init__()
        self.register_buffer("aabb", box.float(), persistent=False)
        self.near, self.far, self.behind = near, far, behind
        self.side = self.measure = float((box[1] - box[0]).max())
        self.longest = float((box[1] - box[0]).norm())

    def divide(self, stride: float) -> None:
        """Set the distance between samples along rays of the space."""
        self.stride = stride

    def spacing(self, shape: Shape) -> float:
        """Length along rays of the space from one vertex of a grid of that shape to the next."""
        return voxel_size(self.aabb, shape[0] * shape[1] * shape[2])

    def local(self, rays: Rays) -> Rays:
        """Transform rays of the world into the space."""
        return rays

    def ends(self, rays: Rays, around: Tensor) -> tuple[Tensor, Tensor]:
        """First and last distance ``[R]`` of the samples on rays of the space; outside the box ``around`` ``[2, 3]``
        there are none."""
        return intersect_box(rays, around, self.near, self.far)

    def unit(self, points: Tensor) -> Tensor:
        """Map points ``[M, 3]`` of the space into the unit cube, scaled by the longest side."""
        return (points - self.aabb[0]) / self.side

    def lengths(self, t: Tensor, points: Tensor) -> Tensor | float:
        """Lengths of samples in units of ``measure``, ``[M]`` or one number for all."""
        return self.stride / self.measure

    def distances(self, rays: Rays, t: Tensor, at: Any) -> Tensor:
        """Distances in the world of samples at ``t`` along the rays ``rays[at]`` of the world."""
        return t

    def place(self, points: Tensor) -> tuple[Tensor, Tensor | float]:
        """Map the world's points ``[M, 3]`` into the space; also give a world unit's length there, in ``measure``."""
        return points, 1 / self.measure


class NDCSpace(Box):
    """Normalised device coordinates of forward-facing cameras: rays run from 0 to 1, the measure is 1."""

    def __init__(self, box: Tensor, ndc: NDC, far: float):
        super().__init__(box, 0.0, 1.0, far)
        self.ndc, self.measure, self.longest = ndc, 1.0, 1.0

    def spacing(self, shape: Shape) -> float:
        return 1 / (shape[2] - 1)

    def local(self, rays: Rays) -> Rays:
        return self.ndc.rays(rays)

    def distances(self, rays: Rays, t: Tensor, at: Any) -> Tensor:
        return self.ndc.distances(rays[at], t, self.behind)

    def place(self, points: Tensor) -> tuple[Tensor, Tensor]:
        local, unit = self.ndc.points(points)
        return local, unit / self.measure


class Ball(Box):
    """Space that is all of the world, contracted into a ball; rays end at infinity.

    Args:
        centre: ``[3]``, centre of the unit ball in the world.
        radius: radius of the unit ball in scene units.
        near: distance in the world at which rays begin.
        behind: see :class:`Box`.
    """

    contracted = True

    def __init__(self, centre: Tensor, radius: float, near: float, behind: float):
        start = float(paced(torch.tensor(near / radius)))
        super().__init__(torch.tensor([[-BALL_RADIUS] * 3, [BALL_RADIUS] * 3]), start, END_PACE, behind)
        self.register_buffer("centre", centre.float(), persistent=False)
        self.radius, self.longest = radius, END_PACE

    def divide(self, stride: float) -> None:
        self.stride, self.far = stride, END_PACE - stride

    def local(self, rays: Rays) -> Rays:
        return Rays((rays.origins - self.centre) / self.radius, rays.directions)

    def ends(self, rays: Rays, around: Tensor) -> tuple[Tensor, Tensor]:
        start = torch.full_like(rays.origins[:, 0], self.near)
        return start, torch.full_like(start, self.far)

    def lengths(self, t: Tensor, points: Tensor) -> Tensor:
        return lengths(t, points) * (self.stride / self.measure)

    def distances(self, rays: Rays, t: Tensor, at: Any) -> Tensor:
        return (travelled(t) * self.radius).clamp_max(self.behind)

    def place(self, points: Tensor) -> tuple[Tensor, Tensor]:
        local = contract((points - self.centre) / self.radius)
        return local, (2 - distance(local)).clamp_max(1.0).square() / (self.measure * self.radius)


def space_of(scene: Scene, geometry: str, box: Tensor | None = None) -> Box:
    """Make the space of a scene for a geometry, over a box ``[2, 3]``, by default all that cameras see."""
    train, near, far = scene.train, scene.near, scene.far
    if geometry == "unbounded":
        return Ball(*camera_ball(train, near), near, far)
    if geometry == "bounded":
        return Box(frustum_box(train, near, far) if box is None else box, near, far, far)
    ndc = ndc_of(scene)
    if box is None:
        box = ray_box(ndc.rays(edge_rays(train)), 0.0, 1.0)
        box[:, 2] = torch.tensor([-1.0, 1.0])  # but for rounding
    return NDCSpace(box, ndc, far)
