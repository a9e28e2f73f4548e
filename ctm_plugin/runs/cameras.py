"""A run's note of its scene without pictures, which is enough to render when the data are gone."""

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
from ctm_plugin.runs.rundir import METRICS, read_json
from ctm_plugin.scene.kinds import BACKGROUNDS, GEOMETRIES
from ctm_plugin.scene.poses import Similarity
from ctm_plugin.scene.views import Scene, Views

CAMERAS_FILE = "cameras.json"
"""Name of a run's file of training and test cameras, bounds and light: all of its scene but the pictures."""
COPIED = ("name", "near", "far", "geometry", "background")
"""Attributes of a scene that the file of cameras holds unchanged."""


def note_cameras(run: Path, module: PosedBackbone) -> None:
    """Write the file of cameras of a run's scene: cameras, bounds, background, masks and light, but no picture."""
    scene, world = module.scene, module.scene.world
    note = {
        **{name: getattr(scene, name) for name in COPIED},
        "dark": scene.dark,
        # With something that tells pictures apart it hangs on the weights: metrics.json has it in the end.
        "light": astuple(module.light) if module.appearance is None else None,
        "world": world and {**world._asdict(), "turn": world.turn.tolist(), "shift": world.shift.tolist()},
        **{split: _note(getattr(scene, split)) for split in ("train", "test")},
    }
    write_text(run / CAMERAS_FILE, json.dumps(note, allow_nan=False) + "\n")


def _note(views: Views) -> dict[str, Any]:
    mask, exposures = views.mask, views.exposures
    if mask is not None:  # lengths of its runs, row by row over all views, from one that does not count on
        flat = mask.cpu().numpy().ravel()
        mask = np.diff(np.flatnonzero(np.diff(flat, prepend=False)), prepend=0, append=len(flat)).tolist()
    if exposures is not None and exposures.isnan().any():  # nothing starts from those
        exposures = None
    tables = {"c2w": views.c2w, "intrinsics": views.intrinsics, "distortion": views.distortion, "exposures": exposures}
    return {
        "size": [views.height, views.width, views.images.shape[3]],
        "bytes": views.images.dtype == torch.uint8,
        "names": list(views.names),
        "sizes": None if views.sizes is None else views.sizes.tolist(),
        "mask": mask,
        **{name: None if table is None else table.tolist() for name, table in tables.items()},
    }


def noted_scene(run: Path) -> Scene | None:
    """Read a run's scene out of its file of cameras, with pictures of one grey level; ``None``: there is no file.

    Raises:
        CheckpointError: the file cannot be used.
    """
    if not (run / CAMERAS_FILE).is_file():
        return None
    note = read_json(run / CAMERAS_FILE)
    try:
        light, world = note["light"], note["world"]
        if light is None:
            if not (run / METRICS).is_file():
                return None
            scores = read_json(run / METRICS)
            light = scores["light_factor"], scores["light_contrast"], scores["light_saturation"]
        gain, contrast, saturation = map(float, light)
        if world is not None:
            tables = {"turn": _table(world["turn"], 3, 3), "shift": _table(world["shift"], 3)}
            world = Similarity(**{**world, **{name: table.numpy() for name, table in tables.items()}})
            _check(0 < world.scale < float("inf"), "world")
        _check(all(0 < each < float("inf") for each in (gain, contrast)) and 0 <= saturation < float("inf"), "light")
        _check(0 <= note["near"] < note["far"] < float("inf"), "near")
        _check(note["geometry"] in GEOMETRIES and note["background"] in BACKGROUNDS, "geometry")
        views = {split: _views(note[split], note["dark"]) for split in ("train", "test")}
        return Scene(**{name: note[name] for name in COPIED}, **views, world=world, light=(gain, contrast, saturation))
    except (KeyError, TypeError, ValueError, RuntimeError, OverflowError) as error:
        found = f"no cameras ({type(error).__name__}: {error})"
        raise CheckpointError(run / CAMERAS_FILE, found, "what a run writes there") from error


def _views(note: Any, dark: Any) -> Views:
    names, (height, width, channels), mask = note["names"], note["size"], note["mask"]
    count, sizes = len(names), {"c2w": (3, 4), "intrinsics": (4,), "distortion": (5,), "exposures": ()}
    _check(min(height, width) > 0 and height * width <= MAX_PIXELS and channels in (3, 4), "size")
    # Files are named by them.
    _check(all(isinstance(name, str) and Path(name).name == name and "\\" not in name for name in names), "names")
    _check(0 < len(set(names)) == count, "names")
    own = note.get("sizes")  # older versions have none
    if own is not None:
        own = _table(own, count, 2).long()
        _check(bool(((own > 0) & (own <= torch.tensor([height, width]))).all()), "sizes")
    level = torch.full((1,), float(not dark)) * (255 if note["bytes"] else 1)
    level = level.byte() if note["bytes"] else level
    if mask is not None:
        _check(min(mask) >= 0 and sum(mask) == count * height * width, "mask")
        mask = torch.from_numpy(np.repeat(np.arange(len(mask)) % 2 == 1, mask)).view(count, height, width)
    return Views(
        images=level.expand(count, height, width, channels),
        names=tuple(names),
        mask=mask,
        sizes=own,
        pictured=torch.zeros(count, dtype=torch.bool),
        **{key: None if note[key] is None else _table(note[key], count, *size).float() for key, size in sizes.items()},
    )


def _table(rows: Any, *shape: int) -> Tensor:
    table = torch.tensor(rows, dtype=torch.float64)
    _check(table.shape == shape and bool(table.float().isfinite().all()), str(list(shape)))
    return table


def _check(suits: bool, what: str) -> None:
    if not suits:
        raise ValueError(what)
