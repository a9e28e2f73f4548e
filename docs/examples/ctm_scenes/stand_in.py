"""A stand-in for Blender that paints flat pictures."""

import contextlib
from types import SimpleNamespace

import numpy as np
from ctm_scenes.cycles import FoundCamera
from ctm_scenes.spec import SceneSpec
from ctm_scenes.trajectory import hemisphere, look_at, orbit

TABLE = SceneSpec(
    name="table",
    build=lambda: None,
    train=lambda count, seed: hemisphere(count, 4.0, seed=seed),
    test=lambda count, seed: orbit(count, 4.0),
    camera_angle_x=0.6,
    near=2.0,
    far=6.0,
)
"""A scene of a plug-in."""


class Painter:
    """In place of ``ctm_scenes.cycles``: flat grey or distance 4 in the left half, nothing on the right."""

    def __init__(self):
        self.taken = 0
        self.stop_after = None

    def __getattr__(self, name):
        return lambda *_: None

    def require_bpy(self):
        return SimpleNamespace(app=SimpleNamespace(version_string="stand-in"))

    def quiet(self):
        return contextlib.nullcontext()

    def open_blend(self, path):
        return FoundCamera(look_at(np.array([0.0, -5.0, 1.0])), 0.8)

    def reach(self, camera):
        return 4.0

    def set_up_cycles(self, width, height, *_):
        self.shape = (height, width)

    def use_radiance(self, *_):
        self.value = 0.5

    def use_distance(self):
        self.value = 4.0

    def picture(self):
        if self.taken == self.stop_after:
            raise KeyboardInterrupt
        self.taken += 1
        image = np.zeros((*self.shape, 4), dtype=np.float32)
        image[:, : self.shape[1] // 2] = [self.value, self.value, self.value, 1.0]
        return image
