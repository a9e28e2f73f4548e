"""Spaces in which samples lie evenly along rays: a box of the world, NDC, or all of space contracted."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.contraction import BALL_RADIUS, END_PACE, lengths, paced, travelled
from ctm_plugin.rays.grid import Shape, voxel_size
from ctm_plugin.rays.ndc import NDC
from ctm_plugin.rays.sampling import intersect_box
from ctm_plugin.scene.frustum import camera_ball, edge_rays, frustum_box, ndc_of, ray_box
from ctm_plugin.scene.views import Scene


class Box(nn.Module):
    """A box of the world. Its rays are the world's, and run from ``near`` to ``far``.

    Args:
        box: ``[2, 3]``, in the space.
        near, far: the part of its rays that is looked at.
        behind: distance in the world at which light that nothing stops counts as stopped.

    Attributes:
        stride: between samples along its rays, once :meth:`divide` has set it.
        measure: what a length along its rays is divided by to become an optical depth's; the box's longest side.
        side: the box's longest.
        longest: no ray is longer in it.
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
        """Set the distance between samples along its rays."""
        self.stride = stride

    def spacing(self, shape: Shape) -> float:
        """Length along its rays from one vertex of a grid of that shape to the next."""
        return voxel_size(self.aabb, shape[0] * shape[1] * shape[2])

    def local(self, rays: Rays) -> Rays:
        """The world's rays in the space."""
        return rays

    def ends(self, rays: Rays, around: Tensor) -> tuple[Tensor, Tensor]:
        """First and last distance ``[R]`` of the samples of its rays; outside the box ``around`` ``[2, 3]`` all is
        free."""
        return intersect_box(rays, around, self.near, self.far)

    def unit(self, points: Tensor) -> Tensor:
        """Its points ``[M, 3]`` in the unit cube, scaled by the longest side."""
        return (points - self.aabb[0]) / self.side

    def lengths(self, t: Tensor, points: Tensor) -> Tensor | float:
        """Lengths of samples, ``[M]`` or one number for all, in ``measure``."""
        return self.stride / self.measure

    def distances(self, rays: Rays, t: Tensor, at: Any) -> Tensor:
        """Distances in the world of samples at ``t`` on the lines of ``rays[at]``, the world's."""
        return t


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


class Ball(Box):
    """All of space, contracted; rays end at infinity.

    Args:
        centre: ``[3]``, of the unit ball in the world.
        radius: of it.
        near: where rays begin, in the world.
        behind: as of a box.
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


def space_of(scene: Scene, geometry: str, box: Tensor | None = None) -> Box:
    """The space of a scene by its geometry; with a box ``[2, 3]`` in place of all that cameras see."""
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
