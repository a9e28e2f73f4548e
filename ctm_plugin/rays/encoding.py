"""Positional encoding."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def embed(points: Float[Tensor, "*n d"], frequencies: Float[Tensor, " p"]) -> Float[Tensor, "*n e"]:
    """Embed as ``[x, sin(f_p x), cos(f_p x)]`` with E = D (1 + 2 P) numbers: all sines by rising p, then all cosines.

    Example:
        >>> embed(torch.zeros(1, 3), torch.ones(1)).tolist()
        [[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0]]
    """
    angles = (points[..., None, :] * frequencies[:, None]).flatten(-2)
    return torch.cat([points, angles.sin(), angles.cos()], dim=-1)
