"""The four scenes, rendered by Blender, and those of them that the package ships: ``make test-blender``."""

import json

import numpy as np
import pytest

pytest.importorskip("bpy", reason="bpy is not installed: make test-blender", exc_type=ImportError)

from ctm_scenes import cycles
from ctm_scenes.render import distance
from ctm_scenes.stairwell import STAIRWELL
from ctm_scenes.still_life import STILL_LIFE
from ctm_scenes.white_room import WHITE_ROOM
from ctm_scenes.workshop import WORKSHOP

from ctm_plugin.data.embedded import ASSETS
from ctm_plugin.data.llff import read_poses


@pytest.mark.parametrize("spec", [STAIRWELL, STILL_LIFE, WHITE_ROOM, WORKSHOP], ids=lambda spec: spec.name)
def test_light_is_linear_and_bounds_hold(spec):
    """At light 1 and 0.02: the same picture scaled; what is seen lies between near and far."""
    pose = spec.train(9, 0)[4]
    taken = {}
    for light in (1.0, 0.02):
        cycles.empty_scene(spec.build)
        cycles.dim(light)
        cycles.set_up_cycles(32, 24, spec.camera_angle_x, spec.near, spec.far)
        cycles.use_radiance(128, 0, True, spec.transparent)
        cycles.place_camera(pose)
        taken[light] = cycles.picture()
    lit, dark = taken[1.0][..., :3], taken[0.02][..., :3]
    assert lit.shape == (24, 32, 3)
    assert lit.max() > 0.3
    # Two estimates by random paths of their own: 128 a pixel, denoised.
    close = np.isclose(dark, 0.02 * lit, rtol=0.1, atol=1e-4)
    assert close.mean() > 0.95
    assert dark.mean() == pytest.approx(0.02 * lit.mean(), rel=0.02)

    cycles.use_distance()
    seen = distance(cycles.picture())
    assert np.isnan(seen).any() == spec.transparent
    assert spec.near < np.nanmin(seen) < np.nanmax(seen) < spec.far


@pytest.mark.parametrize("light", ["lit", "dark"])
def test_the_package_ships_the_still_life_of_these_cameras(light):
    for split, count in (("train", 100), ("test", 25)):
        found = json.loads((ASSETS / "still_life" / light / f"transforms_{split}.json").read_text())
        assert (found["near"], found["far"]) == (STILL_LIFE.near, STILL_LIFE.far)
        assert found["camera_angle_x"] == STILL_LIFE.camera_angle_x
        poses = [frame["transform_matrix"] for frame in found["frames"]]
        np.testing.assert_allclose(poses, getattr(STILL_LIFE, split)(count, 0), atol=1e-12)


@pytest.mark.parametrize("light", ["lit", "dark"])
def test_the_package_ships_the_white_room_of_these_cameras(light):
    poses, _, bounds = read_poses(ASSETS / "white_room" / light / "poses_bounds.npy", bounded=True)
    np.testing.assert_allclose(poses, WHITE_ROOM.train(49, 0)[:, :3], atol=1e-9)
    assert WHITE_ROOM.near < bounds.min() < bounds.max() < WHITE_ROOM.far
