"""More Gaussians where the picture pulls at them: 3DGS's adaptive density control."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ctm_plugin.splats.gaussians import Gaussians, rotations

GROW_SCALE3D = 0.01
"""Standard deviation, in extents of the cameras, from which on a Gaussian is split; smaller ones are duplicated
(gsplat's ``grow_scale3d``)."""
MIN_GAUSSIANS = 100
"""Least number of Gaussians that pruning leaves: a field without any would never learn again."""
SPLIT_FACTOR = 1.6
"""Ratio of the scale of a Gaussian to that of the two it is split into."""


class Change(NamedTuple):
    """Which Gaussians stay, by index, and what comes after them."""

    kept: Int[Tensor, " m"]
    added: Gaussians


@torch.no_grad()
def densify(
    gaussians: Gaussians,
    push: Float[Tensor, " n"],
    threshold: float,
    extent: float,
    most: int,
    pruned: float,
    normal: Float[Tensor, "n 6"],
) -> Change:
    """Give a twin to what is small, split what is large, where the pull is above a threshold; drop what hardly shows.

    Args:
        gaussians: N of them.
        push: the mean length of the gradient of their means on the picture, in halves of its sides.
        threshold: of ``push``; infinity: only drop.
        extent: of the cameras, in scene units.
        most: Gaussians at most; where more would come, those that are pulled at hardest go first.
        pruned: opacity below which one is dropped.
        normal: from N(0, 1), where the halves of a split one lie, in its own standard deviations.
    """
    stays = shows(gaussians, pruned)
    grows = stays & (push > threshold)  # what goes would leave its twin, NaN and all
    room = max(most - len(push), 0)
    if int(grows.sum()) > room:
        grows &= push > push.where(grows, 0.0).sort(descending=True).values[room]
    large = gaussians.scales.amax(1).exp() > GROW_SCALE3D * extent
    twins, split = (grows & ~large).nonzero().squeeze(1), (grows & large).nonzero().squeeze(1)
    halves = Gaussians(*(table[split].repeat(2, 1) for table in gaussians))
    away = normal[split].view(-1, 2, 3).transpose(0, 1).reshape(-1, 3) * halves.scales.exp()
    halves = halves._replace(
        means=halves.means + (rotations(halves.turns) @ away[:, :, None])[:, :, 0],
        scales=halves.scales - math.log(SPLIT_FACTOR),
    )
    stays[split] = False
    added = Gaussians(*(torch.cat([table[twins], half]) for table, half in zip(gaussians, halves, strict=True)))
    return Change(stays.nonzero().squeeze(1), added)


def shows(gaussians: Gaussians, pruned: float) -> Bool[Tensor, " n"]:
    """Tell which Gaussians are finite and at least so opaque; where none is, which are the most opaque."""
    finite = torch.stack([table.isfinite().all(1) for table in gaussians]).all(0)
    opacities = torch.where(finite, gaussians.opacities[:, 0].sigmoid(), -1.0)
    shown = opacities >= pruned
    if not shown.any() and len(shown):
        shown = finite & (opacities >= opacities.topk(min(MIN_GAUSSIANS, len(shown))).values[-1])
    return shown
