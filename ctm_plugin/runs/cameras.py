"""A scene as its run keeps it, without its pictures: enough to render, where the data are gone."""

from __future__ import annotations

import json
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ctm_plugin.backbones.posed import PosedBackbone
from ctm_plugin.data.readers.picture import MAX_PIXELS
from ctm_plugin.errors import CheckpointError
from ctm_plugin.files import write_text
from ctm_plugin.runs.rundir import METRICS
from ctm_plugin.runs.safe_read import read_json
from ctm_plugin.scene.kinds import BACKGROUNDS, GEOMETRIES
from ctm_plugin.scene.poses import Similarity
from ctm_plugin.scene.views import Scene, Views

CAMERAS = "cameras.json"
"""A run's cameras, of training and test views, and what else of its scene is no picture."""
WORLD = {"turn": (3, 3), "shift": (3,)}
SAME = ("name", "near", "far", "geometry", "background")
"""Of a scene, as they are."""


def note_cameras(run: Path, module: PosedBackbone) -> None:
    """Write down how a run's scene is looked at: cameras, bounds, background, masks and light, but no picture."""
    scene, world = module.scene, module.scene.world
    note = {
        **{name: getattr(scene, name) for name in SAME},
        "dark": scene.dark,
        # With something that tells pictures apart it hangs on the weights: metrics.json has it in the end.
        "light": astuple(module.light) if module.appearance is None else None,
        "world": world and {**world._asdict(), "turn": world.turn.tolist(), "shift": world.shift.tolist()},
        **{split: _note(getattr(scene, split)) for split in ("train", "test")},
    }
    write_text(run / CAMERAS, json.dumps(note, allow_nan=False) + "\n")


def _note(views: Views) -> dict[str, Any]:
    distortion, mask, exposures = views.distortion, views.mask, views.exposures
    if mask is not None:  # lengths of its runs, row by row over all views, from one that does not count on
        flat = mask.cpu().numpy().ravel()
        mask = np.diff(np.flatnonzero(np.diff(flat, prepend=False)), prepend=0, append=len(flat)).tolist()
    if exposures is not None and exposures.isnan().any():  # nothing starts from those
        exposures = None
    return {
        "size": [views.height, views.width, views.images.shape[3]],
        "bytes": views.images.dtype == torch.uint8,
        "names": list(views.names),
        "c2w": views.c2w.tolist(),
        "intrinsics": views.intrinsics.tolist(),
        "distortion": None if distortion is None else distortion.tolist(),
        "mask": mask,
        "exposures": None if exposures is None else exposures.tolist(),
    }


def noted_scene(run: Path) -> Scene | None:
    """The scene of a run without its pictures, which are one level everywhere; ``None``: it is not written down.

    Raises:
        CheckpointError: what is written down cannot be used.
    """
    if not (run / CAMERAS).is_file():
        return None
    note = read_json(run / CAMERAS)
    try:
        light = note["light"]
        if light is None:
            if not (run / METRICS).is_file():
                return None
            scores = read_json(run / METRICS)
            light = scores["light_factor"], scores["light_contrast"], scores["light_saturation"]
        gain, contrast, saturation = map(float, light)
        world = note["world"]
        if world is not None:
            tables = {name: np.array(world[name], dtype=np.float64).reshape(*shape) for name, shape in WORLD.items()}
            world = Similarity(**{**world, **tables})
            _check(np.isfinite(world.scale) and world.scale > 0, "world")
            _check(all(np.isfinite(table).all() for table in tables.values()), "world")
        _check(all(0 < each < float("inf") for each in (gain, contrast)) and 0 <= saturation < float("inf"), "light")
        _check(0 <= note["near"] < note["far"] < float("inf"), "near")
        _check(note["geometry"] in GEOMETRIES and note["background"] in BACKGROUNDS, "geometry")
        views = {split: _views(note[split], note["dark"]) for split in ("train", "test")}
        return Scene(**{name: note[name] for name in SAME}, **views, world=world, light=(gain, contrast, saturation))
    except (KeyError, TypeError, ValueError, RuntimeError, OverflowError) as error:
        found = f"no cameras ({type(error).__name__}: {error})"
        raise CheckpointError(run / CAMERAS, found, "what a run writes there") from error


def _views(note: Any, dark: Any) -> Views:
    names, (height, width, channels) = note["names"], note["size"]
    count = len(names)
    _check(min(height, width) > 0 and height * width <= MAX_PIXELS and channels in (3, 4), "size")
    # Files are named by them.
    _check(all(isinstance(name, str) and Path(name).name == name and "\\" not in name for name in names), "names")
    _check(0 < len(set(names)) == count, "names")
    level = torch.zeros(1, dtype=torch.uint8 if note["bytes"] else torch.float32)
    if not dark:
        level += 255 if note["bytes"] else 1
    mask = note["mask"]
    if mask is not None:
        _check(min(mask) >= 0 and sum(mask) == count * height * width, "mask")
        mask = torch.from_numpy(np.repeat(np.arange(len(mask)) % 2 == 1, mask)).view(count, height, width)
    return Views(
        level.expand(count, height, width, channels),
        _table(note["c2w"], count, 3, 4),
        _table(note["intrinsics"], count, 4),
        tuple(names),
        distortion=None if note["distortion"] is None else _table(note["distortion"], count, 5),
        mask=mask,
        pictured=torch.zeros(count, dtype=torch.bool),
        exposures=None if note["exposures"] is None else _table(note["exposures"], count),
    )


def _table(rows: Any, *shape: int) -> Tensor:
    table = torch.tensor(rows, dtype=torch.float32)
    _check(table.shape == shape and bool(table.isfinite().all()), str(list(shape)))
    return table


def _check(suits: bool, what: str) -> None:
    if not suits:
        raise ValueError(what)
