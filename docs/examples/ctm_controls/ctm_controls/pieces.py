"""Colours under a matrix, and under increasing curves of straight pieces, one a channel, over equal steps of [0, 1].

The outer pieces go on beyond.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.color.srgb import Colors

Knots = Float[Tensor, "3 n"]


def along(knots: Knots, values: Colors) -> tuple[Colors, Colors]:
    """The curves at ``values``, and their slopes there.

    Args:
        knots: ``[3, n + 1]``, increasing: what each channel's curve is at 0, 1/n, ..., 1.
        values: ``[..., 3]``.
    """
    count = knots.shape[1] - 1
    index = (values.detach() * count).floor().clamp(0, count - 1).long()
    channel = torch.arange(3, device=values.device)
    start, rise = knots[channel, index], knots.diff()[channel, index]
    return start + (values * count - index) * rise, rise * count


def back(knots: Knots, values: Colors) -> Colors:
    """Where the curves are ``values``; arguments as of :func:`along`."""
    count = knots.shape[1] - 1
    found = torch.searchsorted(knots.detach().contiguous(), values.detach().reshape(-1, 3).T.contiguous(), right=True)
    index = (found.T.reshape(values.shape) - 1).clamp(0, count - 1)
    channel = torch.arange(3, device=values.device)
    return (index + (values - knots[channel, index]) / knots.diff()[channel, index]) / count


def times(matrix: Float[Tensor, "3 3"], colors: Colors) -> Colors:
    """Each colour under a matrix: a product that neither autocast nor TF32 touch."""
    return (matrix * colors[..., None, :]).sum(-1)
