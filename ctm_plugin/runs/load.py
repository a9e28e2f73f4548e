"""Loading of a run from its directory: its checkpoint, its module with weights, pictures of it from any camera."""

from __future__ import annotations

import os
import shlex
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.backbones.base import Backbone
from ctm_plugin.color.light import Light
from ctm_plugin.cpu.allocator import keep_memory
from ctm_plugin.errors import CheckpointError, CTMError
from ctm_plugin.files import check_zip
from ctm_plugin.metrics.precision import full_float32
from ctm_plugin.runs.assemble import Parts, assemble
from ctm_plugin.runs.cameras import CAMERAS_FILE, noted_scene
from ctm_plugin.runs.data import check_data, located, note_data
from ctm_plugin.runs.rundir import CONFIG, DAMAGED, LAST, PREVIOUS, differences, load_config, locked
from ctm_plugin.scene.poses import IDENTITY
from ctm_plugin.scene.views import Views
from ctm_plugin.settings.build import Config
from ctm_plugin.show.pictures import depth_picture, latent_picture

VIEW_KINDS = ("lit", "rgb", "latent", "depth")
"""Kinds of pictures that a view is rendered as."""


@dataclass(frozen=True)
class LoadedRun:
    """A run as it was at its last checkpoint.

    Attributes:
        parts: the run's objects, with trained weights.
        config: the run's configuration.
        step: optimizer step of the checkpoint.
        spent: seconds and memory of its training, see :class:`ctm_plugin.callbacks.stopwatch.Stopwatch`.
    """

    parts: Parts
    config: dict[str, Any]
    step: int
    spent: dict[str, float]

    @property
    def module(self) -> Backbone:
        return self.parts.backbone

    @cached_property
    def light(self) -> Light:
        """Light in which the run's pictures are displayed by default."""
        return self.module.light

    def render(
        self, c2w: Float[np.ndarray, "r 4"], intrinsics: Sequence[float], width: int, height: int,
        kind: str = "lit",
    ) -> Float[Tensor, "h w 3"]:  # fmt: skip
        """Render a picture from any camera, on the CPU; the run's scene must have cameras.

        Args:
            c2w: camera to world in the world of the run's files, ``[3, 4]`` or ``[4, 4]``; x right, y up, looking
                along -z.
            intrinsics: fx, fy, cx, cy in pixels; the first pixel's centre is at 0.5.
            width, height: in pixels.
            kind: one of :data:`VIEW_KINDS`.

        Returns:
            sRGB in [0, 1]; depths and latents as colours.
        """
        pose = (self.module.scene.world or IDENTITY).of_poses(np.asarray(c2w, dtype=np.float64)[None, :3])
        views = Views(
            torch.zeros(1, height, width, 3, dtype=torch.uint8), torch.from_numpy(pose).float(),
            torch.tensor([intrinsics], dtype=torch.float32), ("view",),
        )  # fmt: skip
        with full_float32(self.module.device):
            view = self.module.render_view(views, 0)
        return self.picture({name: value.float().cpu() for name, value in view.items()}, kind)

    def picture(self, view: dict[str, Tensor], kind: str, light: Light | None = None) -> Float[Tensor, "h w 3"]:
        """Make a picture of one of :data:`VIEW_KINDS` out of a :meth:`PosedBackbone.render_view` result, on the CPU.

        ``light`` is the light of lit pictures; ``None``: the scene's own.
        """
        if kind == "depth":
            return depth_picture(view["depth"], self.module.scene.near, self.module.scene.far)
        if kind == "latent":
            return latent_picture(view["latent"])
        return (light or self.light).apply(view["rgb"]) if kind == "lit" else view["rgb"]


def load_run(run: Path, root: str | None = None, pictures: bool = True, scene: Any = None) -> LoadedRun:
    """Read a run again, as it was at its last checkpoint.

    Args:
        run: its directory.
        root: the folder of its data, where that is not found from the run; a warning tells of other data.
        pictures: whether the data's pictures are needed; else the run's file of cameras suffices if data are missing.
        scene: the run's scene, where it has been read already.

    Raises:
        CTMError: the folder is no run, its data are not found, or its checkpoint cannot be used.
    """
    keep_memory()
    config = load_config(run)
    checkpoint = load_checkpoint(run, config)
    try:
        config = located(config, run, root) if scene is None else config
    except CheckpointError:
        scene = None if pictures else noted_scene(run)
        if scene is None:
            raise
        warnings.warn(f"{run}: its photographs are gone; it goes by the cameras in {CAMERAS_FILE}", stacklevel=2)
    parts = assemble(config, scene=scene)
    if scene is None and check_data(run, parts.scene) and root is not None:
        with suppress(OSError):  # a run that may only be read
            note_data(run, config, parts.scene)  # the next command finds them
    restore(parts, checkpoint, run / LAST)
    parts.backbone.to("cuda" if torch.cuda.is_available() and parts.trainer.accelerator != "cpu" else "cpu")
    # The rest of the checkpoint, weights and moments, would be held as long.
    return LoadedRun(parts, config, checkpoint["global_step"], checkpoint["callbacks"]["Stopwatch"])


def load_posed(run: Path, root: str | None = None, pictures: bool = True, scene: Any = None) -> LoadedRun:
    """Read a run of a scene with cameras, ready to render; see :func:`load_run`.

    Raises:
        CTMError: the folder is no run, its checkpoint cannot be used, or it is not of a scene with cameras.
    """
    loaded = load_run(run, root, pictures, scene)
    if not loaded.module.posed:
        raise CTMError(f"{run}: found a run of another kind, expected one of a scene that cameras look at")
    loaded.module.eval()
    return loaded


def restore(parts: Parts, checkpoint: dict[str, Any], path: Path) -> None:
    """Load a checkpoint's weights into the module of a run's parts.

    Raises:
        CheckpointError: the weights do not fit, as when another version of a backbone made them.
    """
    module = parts.backbone
    try:
        module.on_load_checkpoint(checkpoint)
        module.load_state_dict(checkpoint["state_dict"])
        for name, parameter in module.named_parameters():
            if not parameter.isfinite().all():
                raise ValueError(f"NaN or infinity in {name}")
    except (KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        found = f"weights that do not fit ({' '.join(str(error).split())[:200]})"
        raise CheckpointError(path, found, "those of this version's model") from error


def load_checkpoint(run: Path, config: Config, name: str = LAST) -> dict[str, Any]:
    """Read a checkpoint of a run, by default the last one, with ``weights_only=True``.

    Raises:
        CheckpointError: there is no checkpoint, it cannot be read (the one before it is offered), or it was made with
            another configuration.
    """
    path = run / name
    if not path.is_file():
        raise CheckpointError(run, f"no {name}", "a checkpoint")
    try:
        check_zip(path)
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # unpicklers raise anything on a damaged file
        before = shlex.quote(str(run / PREVIOUS))
        offer = f"; the one before it: python -m ctm_plugin resume={before}" if (run / PREVIOUS).is_file() else ""
        found = f"an unreadable file ({type(error).__name__})"
        raise CheckpointError(path, found, f"a checkpoint{offer if name == LAST else ''}") from error
    if not _is_checkpoint(checkpoint):
        raise CheckpointError(path, "a file of another kind", "a checkpoint of ctm_plugin")
    # Where the data lie may change, see ctm_plugin.runs.data.
    differing = [key for key in differences(checkpoint["config"], config) if key != "dataset.root"]
    if differing:
        found = f"another configuration (differs in {', '.join(differing)})"
        raise CheckpointError(path, found, f"that of {run / CONFIG}")
    return checkpoint


def _is_checkpoint(content: Any) -> bool:
    """Whether content has the form of a run's checkpoint, in the entries that this package reads itself."""
    try:
        spent, steps = content["callbacks"]["Stopwatch"], [content[key] for key in ("batches_seen", "global_step")]
        return (
            isinstance(content["state_dict"], dict)
            and "config" in content
            and all(isinstance(step, int) and step >= 0 for step in steps)
            and spent.keys() == {"seconds", "peak_memory_mb"}
            and all(isinstance(value, float) for value in spent.values())
        )
    except (KeyError, TypeError, AttributeError, IndexError):
        return False


def go_back(path: Path) -> Path:
    """Put the checkpoint before the last one in its place; a damaged last one is kept as ``damaged.ckpt``.

    Args:
        path: ``RUN/checkpoints/previous.ckpt``.

    Returns:
        The run's directory.

    Raises:
        CheckpointError: ``path`` is another file, or cannot be used.
    """
    run = path.parent.parent
    if path.resolve() != (run / PREVIOUS).resolve():
        raise CheckpointError(path, "another file", f"a run directory, or its {PREVIOUS}")
    load_checkpoint(run, load_config(run), PREVIOUS)
    with locked(run):
        with suppress(FileNotFoundError):
            os.replace(run / LAST, run / DAMAGED)
        os.replace(run / PREVIOUS, run / LAST)
    return run
