"""What a backbone is handed to score itself with."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from ctm_plugin.metrics.lpips import LPIPS


@dataclass(frozen=True)
class Scoring:
    """Settings and instruments of a run's scores.

    Attributes:
        dataset: the data set's part of the run's configuration, for the protocol.
        lpips: what :func:`ctm_plugin.metrics.lpips_weights.load_lpips` returned.
        light: by how much lit pictures are brightened, see :func:`ctm_plugin.color.light.factor_of`.
        track: ``track(items, what)`` gives the items back and shows how many are done; by default it shows nothing.
    """

    dataset: Mapping[str, Any] = field(default_factory=dict)
    lpips: tuple[LPIPS | None, str] = (None, "not asked for")
    light: str | float = "auto"
    track: Callable[[Iterable[Any], str], Iterable[Any]] = lambda items, what: items
