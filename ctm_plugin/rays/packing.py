"""Which of the packed samples go on: as many as are chosen, or, where sizes have to stay, a fixed number of places.

A GPU that records a step (:mod:`ctm_plugin.gpu.replay`) launches the same sizes each time, and is not asked how many
samples there are.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import torch
from torch import Tensor

from ctm_plugin.rays.volume import segment_sums

SPARE_FACTOR = 1.25
"""Ratio of places to the samples seen, as their number differs from step to step."""
MIN_USE = 0.6
"""Least share of the places in use; below it there will be fewer places."""
COUNTED_STEPS = 8
"""Steps whose samples are counted before places are fixed."""
STEPS_BETWEEN_CHECKS = 64
"""Steps from one check that all samples had a place to the next."""
PLACES_PER_RAY = 64
"""Unused places on each ray after the last: a ray is one program of a kernel."""


class Packing:
    """Chooses samples, stage after stage, and counts them.

    Args:
        n_rays: R.
        places: of each stage, falling; ``None``: as many as are chosen.

    Attributes:
        counts: of the samples that were chosen in each stage, also those without a place: numbers, or tensors ``[]``
            where there are places.
    """

    def __init__(self, n_rays: int, places: Sequence[int] | None = None):
        self.n_rays, self.places = n_rays, places
        self.counts: list[int | Tensor] = []

    @property
    def rays(self) -> int:
        """R, and the rays of what places the latest stage has left over."""
        spare = 0 if self.places is None else self.places[len(self.counts) - 1]
        return self.n_rays - -spare // PLACES_PER_RAY

    def spare_rays(self, device: torch.device) -> Tensor:
        """The rays ``[N]`` of the places of the stage that comes, as if all were left over."""
        return self.n_rays + torch.arange(self.places[len(self.counts)], device=device) // PLACES_PER_RAY

    def choose(self, mask: Tensor, ray_index: Tensor) -> tuple[Tensor, Tensor]:
        """Give the indices ``[N]``, ascending, of samples in the mask ``[M]``, and on which ray each lies.

        Places that are left over have the index 0, and lie on rays after the last.
        """
        if self.places is None:
            chosen = mask.nonzero().squeeze(1)
            self.counts.append(len(chosen))
            return chosen, ray_index if len(chosen) == len(mask) else ray_index.index_select(0, chosen)
        mask, spare = mask & (ray_index < self.n_rays), self.spare_rays(mask.device)
        self.counts.append(mask.sum())
        chosen = torch.nonzero_static(mask, size=len(spare), fill_value=-1).squeeze(1)
        taken = chosen.clamp_min(0)
        return taken, torch.where(chosen >= 0, ray_index.index_select(0, taken), spare)

    def closed(self, weights: Tensor, ray_index: Tensor) -> tuple[Tensor, Tensor]:
        """Weights ``[N]`` and rays ``[N]`` of the last stage: what is left over weighs nothing, on the last ray."""
        if self.places is None:
            return weights, ray_index
        return torch.where(ray_index < self.n_rays, weights, 0.0), self.within(ray_index)

    def within(self, ray_index: Tensor) -> Tensor:
        """Rays ``[N]``, of places that are left over the last one."""
        return ray_index if self.places is None else ray_index.clamp_max(self.n_rays - 1)

    def sums(self, values: Tensor, ray_index: Tensor) -> Tensor:
        """Add values ``[N, ...]`` up on each of the R rays."""
        return segment_sums(values, ray_index, self.rays)[: self.n_rays]


class Places:
    """Finds how many places the samples of a training's steps need: some steps are watched, then looked at again."""

    def __init__(self) -> None:
        self.found: tuple[int, ...] | None = None
        self.stride = 0.0
        self.steps = 0
        self.watched: list[list[int]] = []
        self.most: Tensor | None = None

    def watch(self, counts: list[int | Tensor]) -> None:
        """Take in how many samples a step has had in each stage: :class:`Packing` counts them, in numbers or ``[]``."""
        if isinstance(counts[0], Tensor):
            self.most.copy_(torch.maximum(self.most, torch.stack(counts)))
        else:
            self.watched = [*self.watched, counts][-COUNTED_STEPS:]

    def settle(self, stride: float, device: torch.device) -> Hashable | None:
        """Count a step, find places for it or give up those found; gives what stays as long as they do, or ``None``.

        Every so many steps a GPU is waited for, to see whether all samples have had one.

        Args:
            stride: of the samples; with another one they are others.
            device: where steps are computed.
        """
        self.steps += 1
        if self.found and self.steps % STEPS_BETWEEN_CHECKS == 0 and not fits(self.most.tolist(), self.found):
            self.found, self.watched = None, []
        if stride != self.stride:
            self.stride, self.found, self.watched = stride, None, []
        if self.found is None and len(self.watched) == COUNTED_STEPS:
            self.found = places_for([max(counts) for counts in zip(*self.watched, strict=True)])
            self.most = torch.zeros(len(self.found), dtype=torch.int64, device=device)
        return self.found and (self.found, self.most.data_ptr())


def places_for(counts: Sequence[int]) -> tuple[int, ...]:
    """Places ``(N, ...)`` for so many samples in each stage, and some to spare.

    They fall from stage to stage, by which :func:`ctm_plugin.backbones.occupied.taken` knows that some are left out.
    """
    sizes: list[int] = []
    for count in counts:
        size = int(SPARE_FACTOR * count) // 1024 * 1024 + 1024
        sizes.append(min(size, sizes[-1] - 1) if sizes else size)
    return tuple(sizes)


def fits(counts: Sequence[int], places: Sequence[int]) -> bool:
    """Whether all samples had a place, and few places were idle."""
    return all(count <= size for count, size in zip(counts, places, strict=True)) and (
        places[0] <= 2048 or counts[0] >= MIN_USE * places[0]
    )
