"""The package's interface for other programs: colour transforms for their trainers, and finished runs."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import torch
from hydra.errors import HydraException
from jaxtyping import Float
from torch import Tensor
from torch.optim import Optimizer

from ctm_plugin.backbones.splat import Splat
from ctm_plugin.color.photometric import Photometric
from ctm_plugin.color.prepare import adam_of, prepare
from ctm_plugin.color.transform import ColorTransform
from ctm_plugin.compose.command_line import compose, conf_dir, explain
from ctm_plugin.errors import ConfigError, CTMError
from ctm_plugin.export.splats import TRAIN_STEPS, plain
from ctm_plugin.runs.assemble import color_transform
from ctm_plugin.runs.load import LoadedRun, load_posed
from ctm_plugin.settings.listing import names
from ctm_plugin.settings.registry import COLOR_SPACES
from ctm_plugin.splats.gaussians import Gaussians

KEY_PREFIXES = ("ctm.", "color_space.", "color_space=")
"""Prefixes of the keys that :func:`transform` takes."""


def transform(name: str = "auto", *keys: str, seed: int = 0) -> ColorTransform:
    """Make a colour transform.

    Args:
        name: what the command line calls it: a choice of ``ctm`` (``auto``, ``on``, ``quick``), or a colour space.
        keys: settings of it, as on the command line: ``ctm.k=4``; ``color_space=NAME`` under a choice of ``ctm``.
        seed: seed of the transform's initial weights.

    Raises:
        CTMError: on another name, or keys that cannot be used.

    Example:
        >>> transform("quick", "ctm.k=4").channels
        4
    """
    choices, spaces = names(conf_dir(), "ctm"), COLOR_SPACES.names()
    if name not in choices + spaces:
        raise ConfigError("transform", name, f"one of {', '.join(choices + spaces)}")
    for key in keys:
        if not key.startswith(KEY_PREFIXES):
            raise ConfigError("transform", key, "settings of the transform: ctm.KEY, color_space or color_space.KEY")
    chosen = [f"ctm={name}"] if name in choices else ["ctm=off", f"color_space={name}"]
    try:
        return color_transform(compose(*chosen, *keys), seed)
    except HydraException as error:
        raise CTMError(explain(error)) from error


def fit(
    transform: ColorTransform, colors: Float[Tensor, "n 3"], seed: int = 0, optimizer: Optimizer | None = None
) -> Optimizer | None:
    """Fit a transform to a scene, before anything is trained in its colours, and pre-train it if its settings say so.

    Args:
        transform: on the device of ``colors``.
        colors: sRGB in [0, 1], of training pixels, some ten thousand.
        seed: seed of the random colours drawn from ``colors``.
        optimizer: the transform's own, of one parameter group; ``None``: an Adam is made.

    Returns:
        The transform's optimizer, to be stepped with the field's; ``None`` if the transform has no parameters.

    Raises:
        ConfigError: ``ctm.lr_decay`` is not 1.
    """
    if transform.learning.lr_decay != 1:
        raise ConfigError("ctm.lr_decay", transform.learning.lr_decay, "1: your training schedules the optimizer")
    optimizer = optimizer or adam_of(transform)
    prepare(transform, optimizer, lambda draws, count: colors[draws.integers(len(colors), count)], seed, colors.device)
    return optimizer


def losses(
    transform: ColorTransform, latent: Float[Tensor, "r k"], rgb: Float[Tensor, "r 3"], kind: str = "mse",
    weight: float = 1.0,
) -> dict[str, Tensor]:  # fmt: skip
    """Compare what a field rendered with the training colours of the same rays.

    Random colours come from torch's default generator.

    Args:
        transform: a fitted one.
        latent: rendered, in [0, 1].
        rgb: sRGB in [0, 1].
        kind: kind of distance: ``mse`` (squared) or ``l1`` (absolute).
        weight: factor on the terms that compare with training colours.

    Returns:
        Terms by name, ``[]`` each. A training minimises their sum.
    """
    with torch.autocast(rgb.device.type, enabled=False):
        photometric, uniform = Photometric(kind=kind, weight=weight), partial(torch.rand, device=rgb.device)
        return transform.losses([latent.float()], rgb.float(), photometric, uniform).terms


class Run(LoadedRun):
    """A finished run, for other programs."""

    def gaussians(self) -> Gaussians:
        """The run's Gaussians in lit sRGB and the world of its files, as ``ctm export`` writes them.

        Raises:
            CTMError: the run has no Gaussians.
        """
        if not isinstance(self.module, Splat):
            raise CTMError(f"found a run of {type(self.module).__name__}, expected one of splats")
        return plain(self.module, self.light, TRAIN_STEPS)


def load_run(run: str | Path) -> Run:
    """Read a run of a scene with cameras, from its directory or its checkpoint's last state.

    Returns:
        Its ``light``, ``render(c2w, intrinsics, width, height)`` and ``gaussians()``, see :class:`Run`.

    Raises:
        CTMError: the folder is no such run, or it cannot be read.
    """
    loaded = load_posed(Path(run), pictures=False)
    return Run(loaded.parts, loaded.config, loaded.step, loaded.spent)
