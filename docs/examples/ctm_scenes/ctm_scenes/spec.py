"""What a scene with a name is: a builder, its cameras and its bounds. A plug-in registers them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ctm_plugin.settings.registry import Registry
from ctm_plugin.settings.setting import Number

SCENES = Registry("scene", "ctm_plugin.scenes", {})
Trajectory = Callable[[int, int], np.ndarray]
"""``(count, seed) -> [count, 4, 4]`` camera-to-world matrices, OpenGL axes."""


@dataclass(frozen=True)
class SceneSpec:
    """A scene that can be rendered by name.

    Attributes:
        name: what the command line calls it.
        build: fills Blender's empty current scene with objects, lamps and a world, at normal light.
        train: camera trajectory.
        test: that of the test views; ``None``: the scene is forward-facing, it has one trajectory, and every eighth of
            its views is for testing.
        camera_angle_x: horizontal field of view in radians.
        near, far: bounds along the rays that hold the whole scene, in scene units; ``None``: to be measured.
        views, test_views: how many by default.
        transparent: whether what lies behind the scene is transparent (else the world's light is seen there).
    """

    name: str
    build: Callable[[], None]
    train: Trajectory
    test: Trajectory | None
    camera_angle_x: Number
    near: Number | None
    far: Number | None
    views: int = 100
    test_views: int = 25
    transparent: bool = True
