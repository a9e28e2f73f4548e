"""What makes of splats a surface where the photographs do not tell: a plane, away from edges of the picture."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

STRIDES = (1, 4)
"""Pixels between the three places in a row whose depths are compared."""
EDGE = 0.03
"""Difference of two colours, of all that the scene's colours fill, at which a fold weighs 1 / e."""
SEEN = 0.1
"""Share of the light that is stopped below which a pixel's depth is not divided by it."""


def bends(
    inverse: Float[Tensor, "h w"], stopped: Float[Tensor, "h w"], colors: Float[Tensor, "h w k"]
) -> Float[Tensor, ""]:
    """How far surfaces are from planes: the mean of ``|d(p - s) - 2 d(p) + d(p + s)| exp(-e / 0.03) W / s``.

    d is the inverse depth, which is linear across the picture of a plane; s goes one way and the other; e is the larger
    of the two differences of colour. Large at a fold within one colour, nearly nothing where the picture has an edge.

    Args:
        inverse: of the depth, rendered, in any unit; its gradient is wanted.
        stopped: the share of the light that made it.
        colors: of the picture, without gradient; what the scene fills is [0, 1].
    """
    surface, terms = inverse / stopped.detach().clamp_min(SEEN), []
    for axis in (0, 1):
        for stride in STRIDES:
            count = surface.shape[axis] - 2 * stride
            if count > 0:
                before, here, after = (surface.narrow(axis, i * stride, count) for i in range(3))
                first, middle, last = (colors.narrow(axis, i * stride, count) for i in range(3))
                edge = torch.maximum((middle - first).abs().mean(-1), (last - middle).abs().mean(-1))
                fold = (before - 2 * here + after).abs() * (-edge / EDGE).exp()
                terms.append(fold.mean() * (surface.shape[1] / stride / len(STRIDES)))
    return sum(terms, inverse.new_zeros(()))
