"""All of space in a ball: what lies beyond the unit ball is drawn into a shell round it (Barron et al., CVPR 2022)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

BALL_RADIUS = 2.0
"""Radius of the ball that all of space is contracted into."""
UNIFORM_DISTANCE = 2.0
"""Distance up to which samples are evenly spaced: a ray that begins in the unit ball has left it by then."""
END_PACE = 2 * UNIFORM_DISTANCE
"""Pace of a point at infinity."""


def distance(points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
    """Measure ``|x|``; torch's own norm of three numbers takes a hundred times as long on a CPU."""
    return points.square().sum(-1).sqrt()


def contract(points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    """Take all of space into the ball of radius 2: ``x`` where ``|x| <= 1``, else ``(2 - 1/|x|) x/|x|`` (eq. 10)."""
    norm = distance(points)[..., None].clamp_min(1.0)
    return points * ((2 - 1 / norm) / norm)


def travelled(pace: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Find how far along a ray the point at a pace lies, in radii: ``s`` up to B = 2, then ``B^2 / (2 B - s)``.

    Equal paces are as long in the ball, about: evenly laid in the unit ball, ever longer outside it.

    Args:
        pace: in [0, 2 B).
    """
    return torch.where(pace <= UNIFORM_DISTANCE, pace, UNIFORM_DISTANCE**2 / (END_PACE - pace))


def paced(distance: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Undo :func:`travelled`: ``d`` up to B = 2, then ``2 B - B^2 / d``."""
    return torch.where(distance <= UNIFORM_DISTANCE, distance, END_PACE - UNIFORM_DISTANCE**2 / distance)


def lengths(pace: Float[Tensor, " n"], points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Measure how long a unit of pace is in the ball, at contracted points.

    ``dt/ds = max(1, t/B)^2`` along the ray times ``(2 - |c|)^2 = 1 / |x|^2`` across the shell, 1 in the unit ball: what
    the ball makes of the length of a ray that leaves it straight.

    Args:
        pace: paces of the points along their rays.
        points: contracted.
    """
    along = (travelled(pace) / UNIFORM_DISTANCE).clamp_min(1.0)
    return (along * (2 - distance(points)).clamp_max(1.0)).square()
