"""Fit and pre-training of a transform, before it trains with a field, and the transform's own optimizer."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.optim import Adam, Optimizer

from ctm_plugin.color.transform import ColorTransform, fitted
from ctm_plugin.draws import Draws, seeded
from ctm_plugin.errors import ConfigError
from ctm_plugin.optim.schedules import exponential

SAMPLE_COLORS = 1 << 15
"""Number of training colours that a transform is fitted to before a field trains."""
PRETRAIN_COLORS = 1024
"""Training colours in a step of pre-training, and as many random colours and random latents."""


def adam_of(transform: ColorTransform) -> Adam | None:
    """Make a transform's own optimizer; ``None`` where it has no parameters."""
    parameters, learning = list(transform.parameters()), transform.learning
    return Adam(parameters, learning.lr, learning.betas, fused=True) if parameters else None


def prepare(
    transform: ColorTransform, optimizer: Optimizer | None, colors: Callable[[Draws, int], Tensor], seed: int,
    device: torch.device | str = "cpu",
) -> None:  # fmt: skip
    """Fit a transform to the scene, then pre-train it, as its ``learning`` says.

    Pre-training minimises the cycle terms on training colours. The result is the same on every process.

    Args:
        transform: on ``device``.
        optimizer: the transform's own, of one parameter group; ``None`` where it has no parameters.
        colors: ``colors(draws, count)``, ``[count, 3]``: random training colours as evaluation shows them.
        seed, device: seed and device of the random numbers.

    Raises:
        ConfigError: all cycle terms weigh nothing.
        CTMError: see :func:`ctm_plugin.color.transform.fitted`.
    """
    with seeded(seed):
        fitted(transform, colors(Draws(seed, 0, device, stream="colors"), SAMPLE_COLORS))
    if optimizer is None:
        return
    (group,) = optimizer.param_groups
    final, steps = group["lr"], transform.learning.pretrain_steps
    first = transform.learning.pretrain_lr or final
    falling = exponential(final / first, steps)
    for step in range(steps):
        group["lr"] = first * falling(step)
        draws = Draws(seed, step, device, stream="pretraining")
        with torch.no_grad():
            rgb = colors(draws, PRETRAIN_COLORS)
        loss = transform.cycle_loss(rgb, draws.uniform)
        if not loss.requires_grad:
            raise ConfigError("ctm.pretrain_steps", steps, "0 where the cycle terms img, rand and latent weigh nothing")
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    group["lr"] = final
    optimizer.zero_grad()
