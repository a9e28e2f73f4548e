"""What a scene of the renderer is: a builder, its cameras and its bounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Number = float | int

Trajectory = Callable[[int, int], np.ndarray]
"""``(count, seed) -> [count, 4, 4]`` camera-to-world matrices, OpenGL axes."""


@dataclass(frozen=True)
class SceneSpec:
    """A scene that can be rendered by name.

    Attributes:
        name: what the command line calls it.
        summary: one line for listings.
        build: fills Blender's empty current scene with objects, lamps and a world, at normal light.
        train, test: camera trajectories of the two splits.
        camera_angle_x: horizontal field of view in radians.
        near, far: bounds along the rays that hold the whole scene, in scene units.
    """

    name: str
    summary: str
    build: Callable[[], None]
    train: Trajectory
    test: Trajectory
    camera_angle_x: Number
    near: Number
    far: Number
