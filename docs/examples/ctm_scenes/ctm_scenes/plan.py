"""What a rendering is to take: a scene with a name or a ``.blend`` file, with the cameras that the settings ask for."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ctm_plugin.data.near_far import FAR, NEAR, is_bound
from ctm_plugin.data.readers.frames import frames_of, read_pose
from ctm_plugin.data.readers.records import read_record
from ctm_plugin.errors import ConfigError
from ctm_plugin.scene.poses import is_field_of_view
from ctm_scenes import cycles
from ctm_scenes.settings import RenderSettings
from ctm_scenes.spec import SCENES, SceneSpec
from ctm_scenes.trajectory import forward_facing, hemisphere, orbit

VIEWS, TEST_VIEWS, FORWARD_VIEWS = 100, 200, 49
"""Numbers of the paper: Synthetic-NeRF's, and Low-Texture-Blender's."""


@dataclass(frozen=True)
class Plan:
    """A scene with its cameras.

    Attributes:
        name: of the scene.
        source: what it was made from, with a hash where that is a file.
        build: fills Blender's current scene.
        cameras: ``[N, 4, 4]`` camera to world by split; forward-facing scenes have the one split ``all``.
        camera_angle_x: horizontal field of view in radians.
        near, far: bounds along the rays; ``None``: to be measured.
        transparent: what lies behind the scene.
    """

    name: str
    source: str
    build: Callable[[], object]
    cameras: dict[str, np.ndarray]
    camera_angle_x: float
    near: float | None
    far: float | None
    transparent: bool

    @property
    def forward(self) -> bool:
        return "all" in self.cameras


def plan(scene: str, settings: RenderSettings) -> Plan:
    """Plan a registered scene by name, or for a path to a ``.blend``, which is opened.

    Raises:
        CTMError: there is no such scene, or the file or the trajectory cannot be used.
    """
    if scene.endswith(".blend"):
        path = Path(scene).expanduser()
        spec = blend_scene(path, settings)
        source = f"{path.name} sha256 {hashlib.sha256(path.read_bytes()).hexdigest()}"
    else:
        spec = SCENES.get(scene)
        source = spec.name
        if settings.trajectory in ("hemisphere", "forward"):
            raise ConfigError("trajectory", settings.trajectory, f"own or a folder: {spec.name} has its own cameras")
        if spec.test is None and settings.test_views:
            raise ConfigError("test_views", settings.test_views, f"0: every eighth view of {spec.name} is for testing")
    if is_folder(settings.trajectory):
        taken = read_trajectory(Path(settings.trajectory).expanduser())
    else:
        cameras = {"all" if spec.test is None else "train": spec.train(settings.views or spec.views, settings.seed)}
        if spec.test is not None:
            cameras["test"] = spec.test(settings.test_views or spec.test_views, settings.seed)
        taken = {"cameras": cameras, "camera_angle_x": spec.camera_angle_x, "near": spec.near, "far": spec.far}
    transparent = spec.transparent if settings.background == "own" else settings.background == "transparent"
    return Plan(spec.name, source, spec.build, transparent=transparent, **taken)


def blend_scene(path: Path, settings: RenderSettings) -> SceneSpec:
    """Make a scene of a ``.blend`` file, with cameras around the origin or in a grid at its own camera.

    Around an object what lies behind is left out, as in Synthetic-NeRF; a room is seen whole.
    """
    camera = cycles.open_blend(path)
    eye, back = camera.pose[:3, 3], camera.pose[:3, 2]
    own = {"name": path.stem, "build": lambda: cycles.open_blend(path), "camera_angle_x": camera.angle_x}
    own |= {"near": None, "far": None}
    if settings.trajectory in ("own", "forward"):
        reach = cycles.reach(camera)
        at = (eye, eye - reach * back, (settings.extent * reach, settings.extent * reach))
        own |= {"test": None, "views": FORWARD_VIEWS, "transparent": False}
        return SceneSpec(train=lambda count, seed: forward_facing(count, *at, seed=seed), **own)
    radius = float(np.linalg.norm(eye))
    if settings.trajectory == "hemisphere" and radius < 1e-6:
        raise ConfigError("trajectory", "hemisphere", f"a camera of {path.name} away from the origin")
    own |= {"test": lambda count, seed: orbit(count, radius), "views": VIEWS, "test_views": TEST_VIEWS}
    return SceneSpec(train=lambda count, seed: hemisphere(count, radius, seed=seed), **own)


def is_folder(trajectory: str) -> bool:
    """Tell whether a trajectory is a data set's folder, none of those with a name."""
    return trajectory not in ("own", "hemisphere", "forward")


def read_trajectory(folder: Path) -> dict[str, Any]:
    """Read cameras, field of view and bounds of a data set in Blender layout, by their names in :class:`Plan`.

    Raises:
        DataError: ``transforms_train.json`` or ``transforms_test.json`` is missing or cannot be used.
    """
    cameras = {}
    for split in ("test", "train"):  # train last: its field of view and bounds are the set's
        record = read_record(folder / f"transforms_{split}.json")
        angle = record.number("camera_angle_x", is_field_of_view, "the field of view in radians, in (0, pi)")
        c2w = np.stack([read_pose(frame) for frame in frames_of(record)])
        cameras[split] = np.concatenate([c2w, np.broadcast_to([[[0.0, 0.0, 0.0, 1.0]]], (len(c2w), 1, 4))], axis=1)
    near, far = (
        record.number(key, is_bound, "a distance >= 0") if key in record else usual
        for key, usual in (("near", NEAR), ("far", FAR))
    )
    return {"cameras": cameras, "camera_angle_x": angle, "near": near, "far": far}
