"""Directions as real spherical harmonics."""

from __future__ import annotations

import math
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor


def harmonics(directions: Float[Tensor, "n 3"], degrees: int) -> Float[Tensor, "n c"]:
    """Evaluate the real spherical harmonics of degrees l < ``degrees``: ``degrees^2`` numbers, by l, then m from -l.

    ``Y_lm = K_lm P_l^|m|(z) cos(m phi)`` for m >= 0, ``sin(|m| phi)`` for m < 0, without the Condon-Shortley phase,
    orthonormal over the sphere; the associated Legendre polynomials by their recurrences, ``sin^m(theta)`` times the
    cosine and the sine as the real and the imaginary part of ``(x + iy)^m``.

    Args:
        directions: unit length.
        degrees: at least 1.
    """
    x, y, z = directions.unbind(-1)
    real, imaginary = [torch.ones_like(z), x][:degrees], [torch.zeros_like(z), y][:degrees]
    for _ in range(2, degrees):
        real, imaginary = [*real, x * real[-1] - y * imaginary[-1]], [*imaginary, x * imaginary[-1] + y * real[-1]]
    # P_l^m over sin^m(theta): P_m^m is a number, P_{m+1}^m = (2m+1) z P_m^m, then by rising l.
    legendre: dict[tuple[int, int], Tensor] = {}
    for m in range(degrees):
        first = math.prod(range(1, 2 * m, 2))
        legendre[m, m] = torch.full_like(z, first)
        if m + 1 < degrees:
            legendre[m + 1, m] = (2 * m + 1) * first * z
        for degree in range(m + 2, degrees):
            further = z * legendre[degree - 1, m] * ((2 * degree - 1) / (degree - m))
            legendre[degree, m] = further.sub(legendre[degree - 2, m], alpha=(degree + m - 1) / (degree - m))
    normed = {key: _norm(*key) * values for key, values in legendre.items()}
    orders = [(degree, order) for degree in range(degrees) for order in range(-degree, degree + 1)]
    # Few operators, each of many numbers: a GPU takes as long for one as for a million.
    azimuthal = torch.stack([real[order] if order >= 0 else imaginary[-order] for _, order in orders], dim=-1)
    return azimuthal * torch.stack([normed[degree, abs(order)] for degree, order in orders], dim=-1)


@cache
def _norm(degree: int, m: int) -> float:
    squared = (2 * degree + 1) / (4 * math.pi) * math.factorial(degree - m) / math.factorial(degree + m)
    return math.sqrt(squared * (2 if m else 1))
