"""Where a field lives whose samples lie evenly along rays: in a box of the world, in NDC, or in all of space."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.contraction import INFINITY, RADIUS, contract, distance, lengths, paced, travelled
from ctm_plugin.rays.ndc import NDC
from ctm_plugin.rays.sampling import intersect_box
from ctm_plugin.scene.frustum import camera_ball, edge_rays, frustum_box, ndc_of, ray_box
from ctm_plugin.scene.views import Scene


class BoxSpace(nn.Module):
    """A box of the world.

    Args:
        box: ``[2, 3]``, in the space.
        near, far: the part of its rays that is looked at.
        behind: distance in the world at which light that nothing stops counts as stopped.
        stride: between samples along its rays.
    """

    contracted = False
    """Whether samples are at paces, and points in the ball, of :mod:`ctm_plugin.rays.contraction`."""

    def __init__(self, box: Tensor, near: float, far: float, behind: float, stride: float):
        super().__init__()
        self.register_buffer("box", box.float(), persistent=False)
        self.near, self.far, self.behind, self.stride = near, far, behind, stride
        self.side = float((box[1] - box[0]).max())

    def local(self, rays: Rays) -> Rays:
        """The world's rays in the space."""
        return rays

    def ends(self, rays: Rays, around: Tensor) -> tuple[Tensor, Tensor]:
        """Where the samples of its rays begin and end, ``[R]`` each; outside ``around`` ``[2, 3]`` all is free."""
        return intersect_box(rays, around, self.near, self.far)

    def unit(self, points: Tensor) -> Tensor:
        """Its points ``[M, 3]`` in the unit cube, of which shorter sides of the box fill a part."""
        return (points - self.box[0]) / self.side

    def lengths(self, t: Tensor, points: Tensor) -> Tensor | float:
        """How long samples are, ``[M]``, in the box's longest side."""
        return self.stride / self.side

    def distances(self, rays: Rays, t: Tensor, ray_index: Tensor) -> Tensor:
        """Distances in the world of samples ``t`` of its rays, ``[M]``; ``rays`` are the world's."""
        return t

    def place(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The world's points ``[M, 3]`` in the space, and how long a unit of length is in the box's sides, ``[M]``.

        As :meth:`lengths` of samples along rays.
        """
        return points, torch.full_like(points[:, 0], 1 / self.side)


class NDCSpace(BoxSpace):
    """What forward-facing cameras see, in normalised device coordinates."""

    def __init__(self, box: Tensor, ndc: NDC, far: float, stride: float):
        super().__init__(box, 0.0, 1.0, far, stride)
        self.ndc = ndc

    def local(self, rays: Rays) -> Rays:
        return self.ndc.rays(rays)

    def lengths(self, t: Tensor, points: Tensor) -> float:
        return self.stride  # t runs from 0 to 1 through the box

    def distances(self, rays: Rays, t: Tensor, ray_index: Tensor) -> Tensor:
        return self.ndc.distances(rays[ray_index], t, self.behind)

    def place(self, points: Tensor) -> tuple[Tensor, Tensor]:
        return self.ndc.points(points)


class BallSpace(BoxSpace):
    """All of space, contracted; rays end at infinity.

    Args:
        centre: ``[3]``, of the unit ball in the world.
        radius: of it.
        near: where rays begin, in the world.
        behind, stride: as of a box.
    """

    contracted = True

    def __init__(self, centre: Tensor, radius: float, near: float, behind: float, stride: float):
        box = torch.tensor([[-RADIUS] * 3, [RADIUS] * 3])
        start = float(paced(torch.tensor(near / radius)))
        super().__init__(box, start, INFINITY - stride, behind, stride)
        self.register_buffer("centre", centre.float(), persistent=False)
        self.radius = radius

    def local(self, rays: Rays) -> Rays:
        return Rays((rays.origins - self.centre) / self.radius, rays.directions)

    def ends(self, rays: Rays, around: Tensor) -> tuple[Tensor, Tensor]:
        start = torch.full_like(rays.origins[:, 0], self.near)
        return start, torch.full_like(start, self.far)

    def lengths(self, t: Tensor, points: Tensor) -> Tensor:
        return lengths(t, points) * (self.stride / self.side)

    def distances(self, rays: Rays, t: Tensor, ray_index: Tensor) -> Tensor:
        return (travelled(t) * self.radius).clamp_max(self.behind)

    def place(self, points: Tensor) -> tuple[Tensor, Tensor]:
        local = contract((points - self.centre) / self.radius)
        return local, (2 - distance(local)).clamp_max(1.0).square() / (self.side * self.radius)


def space_of(scene: Scene, samples: int) -> BoxSpace:
    """The space of a scene's geometry, with ``samples`` samples on a ray as long as any."""
    train, near, far = scene.train, scene.near, scene.far
    if scene.geometry == "forward":
        ndc = ndc_of(scene)
        box = ray_box(ndc.rays(edge_rays(train)), 0.0, 1.0)
        box[:, 2] = torch.tensor([-1.0, 1.0])  # but for rounding
        return NDCSpace(box, ndc, far, 1.0 / samples)
    if scene.geometry == "unbounded":
        return BallSpace(*camera_ball(train, near), near, far, INFINITY / samples)
    box = frustum_box(train, near, far)
    return BoxSpace(box, near, far, far, float((box[1] - box[0]).norm()) / samples)
