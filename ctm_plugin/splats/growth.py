"""3DGS's adaptive density control: duplicate, split and prune Gaussians by the gradients of their means."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Int64
from torch import Tensor

from ctm_plugin.splats.gaussians import Gaussians, rotations

GROW_SCALE3D = 0.01
"""Standard deviation, in extents of the cameras, from which on a Gaussian is split; smaller ones are duplicated
(gsplat's ``grow_scale3d``)."""
MIN_GAUSSIANS = 100
"""Number of the most opaque Gaussians that are kept where none is opaque enough: a field without any never learns."""
SPLIT_FACTOR = 1.6
"""Ratio of the scale of a Gaussian to that of the two it is split into."""
CELL_BITS = 7
"""Logarithm to base 2 of the cells along an axis, in which :func:`along_curve` tells places apart."""


class Change(NamedTuple):
    """A change of the Gaussians: indices of those that stay, and new ones to append."""

    kept: Int[Tensor, " m"]
    added: Gaussians


@torch.no_grad()
def densify(
    gaussians: Gaussians,
    grad2d: Float[Tensor, " n"],
    grow_grad2d: float,
    extent: float,
    cap_max: int,
    prune_opa: float,
    normal: Float[Tensor, "n 6"],
) -> Change:
    """Duplicate small Gaussians and split large ones where ``grad2d`` exceeds a threshold; prune transparent ones.

    Args:
        gaussians: N of them.
        grad2d: mean length of the gradient of the means on the picture, in halves of its sides.
        grow_grad2d: threshold of ``grad2d``; infinity: only prune.
        extent: extent of the cameras, in scene units.
        cap_max: largest number of Gaussians; the largest ``grad2d`` goes first.
        prune_opa: opacity below which one is pruned.
        normal: draws from N(0, 1): offsets of the two halves of a split Gaussian, in its standard deviations.
    """
    stays = shows(gaussians, prune_opa)
    grows = stays & (grad2d > grow_grad2d)  # a pruned one would leave its duplicate, NaN and all
    room = max(cap_max - len(grad2d), 0)
    if int(grows.sum()) > room:
        grows &= grad2d > grad2d.where(grows, 0.0).sort(descending=True).values[room]
    large = gaussians.scales.amax(1).exp() > GROW_SCALE3D * extent
    duplicated, split = (grows & ~large).nonzero().squeeze(1), (grows & large).nonzero().squeeze(1)
    halves = Gaussians(*(table[split].repeat(2, 1) for table in gaussians))
    offsets = normal[split].view(-1, 2, 3).transpose(0, 1).reshape(-1, 3) * halves.scales.exp()
    halves = halves._replace(
        means=halves.means + (rotations(halves.quats) @ offsets[:, :, None])[:, :, 0],
        scales=halves.scales - math.log(SPLIT_FACTOR),
    )
    stays[split] = False
    added = Gaussians(*(torch.cat([table[duplicated], half]) for table, half in zip(gaussians, halves, strict=True)))
    return Change(stays.nonzero().squeeze(1), added)


def shows(gaussians: Gaussians, prune_opa: float) -> Bool[Tensor, " n"]:
    """Tell which Gaussians to keep: those finite and at least as opaque as ``prune_opa``; if none, the most opaque."""
    finite = torch.stack([table.isfinite().all(1) for table in gaussians]).all(0)
    opacities = torch.where(finite, gaussians.opacities[:, 0].sigmoid(), -1.0)
    kept = opacities >= prune_opa
    if not kept.any() and len(kept):
        kept = finite & (opacities >= opacities.topk(min(MIN_GAUSSIANS, len(kept))).values[-1])
    return kept


def along_curve(places: Float[Tensor, "n 3"]) -> Int64[Tensor, " n"]:
    """Order of places along Morton's curve: those that are near in space are near in memory, where a tile finds them.

    Coordinates are taken by rank, in 128 cells an axis with equally many places: what lies far out crowds nothing.
    """
    ranks = places.argsort(dim=0, stable=True).argsort(dim=0)
    cells = (ranks << CELL_BITS) // max(len(places), 1)
    code = torch.zeros_like(cells[:, 0])
    for bit in range(CELL_BITS):
        for axis in range(3):
            code |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return code.argsort(stable=True)
