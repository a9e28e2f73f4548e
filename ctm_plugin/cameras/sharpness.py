"""Pictures that are far less sharp than their neighbours: shaken, or out of focus."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Sequence

import numpy as np
from jaxtyping import Float32

NEIGHBOURS = 4
"""Pictures before one, and after it, that it is compared with."""
LEAST_SHARE = 1 / 3
"""Least sharpness, as a share of the neighbours'. Measured: 0.46 to 0.9 in sharp captures; 0.27 in three of six whose
pictures were averaged over 9 columns, 0.4 and 0.6 in two that noise or smooth things fill."""


def unsharp(lights: Sequence[Float32[np.ndarray, "h w"]], sensors: Sequence[Hashable]) -> list[int]:
    """Numbers of pictures whose sharpness is below ``LEAST_SHARE`` of the median of their neighbours'.

    Sharpness is ``var L`` and ``var L / mean^2`` of the light, with ``L`` its Laplacian; both must be below: one
    is so in less light, or next to pictures whose noise is larger.

    Args:
        lights: linear light, in the order in which they were taken.
        sensors: what took each; pictures of others are no neighbours.
    """
    sharpness, members, hits = np.array([_sharpness(each) for each in lights]), defaultdict(list), []
    for number, sensor in enumerate(sensors):
        members[sensor].append(number)
    for numbers in members.values():
        for place, number in enumerate(numbers):
            near = numbers[max(place - NEIGHBOURS, 0) : place] + numbers[place + 1 : place + 1 + NEIGHBOURS]
            enough = len(near) >= NEIGHBOURS
            if enough and (sharpness[number] < LEAST_SHARE * np.median(sharpness[near], axis=0)).all():
                hits.append(number)
    return sorted(hits)


def _sharpness(light: Float32[np.ndarray, "h w"]) -> tuple[float, float]:
    sides = light[:-2, 1:-1] + light[2:, 1:-1] + light[1:-1, :-2] + light[1:-1, 2:]
    variance = float(np.var(4 * light[1:-1, 1:-1] - sides))
    return variance, variance / max(float(light.mean()), 1e-9) ** 2
