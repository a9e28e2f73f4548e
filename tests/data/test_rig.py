"""How cameras stand: rigs with known answers, and the real captures'."""

import math

import numpy as np
import pytest
from ctm_scenes.trajectory import hemisphere
from layouts import llff_layout, room_poses, transforms_layout

from ctm_plugin.data.llff import LLFFConfig
from ctm_plugin.data.readers.lens import Intrinsics
from ctm_plugin.data.rig import Rig, rig_of, turn
from ctm_plugin.data.transforms import TransformsConfig
from ctm_plugin.settings.registry import DATASETS

CORNER = math.radians(30)


def ring(degrees: float, count: int = 37, outwards: bool = False) -> np.ndarray:
    """``[N, 3, 4]`` cameras on an arc round the origin, z up, that look at it, or away from it."""
    angles = np.radians(np.linspace(0, degrees, count))
    place = 4 * np.stack([np.cos(angles), np.sin(angles), np.zeros(count)], 1)
    back = -place / 4 if outwards else place / 4
    up = np.tile([0.0, 0.0, 1.0], (count, 1))
    return np.stack([np.cross(up, back), up, back, place], 2)


@pytest.mark.parametrize("degrees", [30.0, 120.0, 300.0])
def test_cameras_go_round_as_far_as_their_arc(degrees):
    assert turn(ring(degrees)) == pytest.approx(degrees, abs=1e-6)


def test_who_looks_outwards_goes_round_nothing():
    assert turn(ring(90.0, outwards=True)) == 0.0


@pytest.mark.parametrize(
    ("poses", "corner", "alone", "expected"),
    [
        (room_poses()[:, :3], CORNER, False, "forward"),
        (room_poses()[:, :3], CORNER, True, "bounded"),  # a thing seen from one side needs no planes behind it
        (room_poses()[:, :3], math.radians(79), False, "unbounded"),  # rays nearly across the mean axis
        (hemisphere(40, 4.0, seed=0)[:, :3], CORNER, True, "bounded"),
        (hemisphere(40, 4.0, seed=0)[:, :3], CORNER, False, "unbounded"),
        (ring(40.0), CORNER, False, "forward"),
        (ring(120.0), CORNER, False, "unbounded"),
        (ring(360.0 * 36 / 37, outwards=True), CORNER, False, "unbounded"),
    ],
)
def test_geometry(poses, corner, alone, expected):
    rig = Rig(np.asarray(poses), corner, (10, 10), alone)
    assert rig.geometry()[0] == expected
    # A backbone without unbounded scenes has them bounded.
    assert rig.geometry(("bounded", "forward"))[0] == {"unbounded": "bounded"}.get(expected, expected)


def test_cameras_far_behind_others_do_not_fit_planes():
    poses = room_poses()[:, :3].copy()
    assert Rig(poses, CORNER, (10, 10), False).looks_one_way
    poses[0, :, 3] += 3 * poses[:, :, 2].mean(0)
    poses[1, :, 3] -= 3 * poses[:, :, 2].mean(0)
    assert not Rig(poses, CORNER, (10, 10), False).looks_one_way


def test_the_corner_is_the_widest_ray():
    wide, narrow = Intrinsics(40, 20, 25, 20, 10, 12), Intrinsics(40, 20, 90, 90, 20, 10)
    rig = rig_of([narrow, wide], [room_poses()[0, :3]], (20, 40), False)
    assert rig.corner == pytest.approx(math.atan(math.hypot(30 / 25, 12 / 20)))


def test_loaders_tell_it_without_their_pictures(tmp_path):
    given = {"w": 16, "h": 12, "fl_x": 20.0, "near": 1.0, "far": 7.0}
    root = transforms_layout(tmp_path / "room", room_poses(), **given)
    rig = TransformsConfig(root=root, width=8).rig()
    assert (rig.size, rig.alone, len(rig.c2w)) == ((6, 8), False, 11)
    assert rig.corner == pytest.approx(math.atan(math.hypot(8 / 20, 6 / 20)))
    assert TransformsConfig(root=root).load().geometry == rig.geometry()[0] == "forward"
    assert TransformsConfig(root=root, geometry="bounded").load().geometry == "bounded"


def test_a_row_without_bounds_says_nothing_of_how_near_the_scene_is(tmp_path):
    root = llff_layout(tmp_path / "wall", (16, 12))
    whole = LLFFConfig(root=root).rig()
    rows = np.load(root / "poses_bounds.npy")
    assert whole.near == pytest.approx(rows[:, 15].min())
    rows[rows[:, 15].argmax(), 15:] = np.nan
    np.save(root / "poses_bounds.npy", rows)
    assert LLFFConfig(root=root).rig().near == whole.near
    assert LLFFConfig(root=root).rig().geometry()[0] == "forward"


@pytest.mark.parametrize(
    ("layout", "folder", "settings", "expected"),
    [
        ("transforms", "lom/bike", {"dark": "low"}, "forward"),
        ("transforms", "lom/buu", {"dark": "low"}, "forward"),
        ("transforms", "lom/chair", {"dark": "low"}, "forward"),
        ("transforms", "realx3d/BlueHawaii", {}, "forward"),
        ("transforms", "realx3d/Cupcake", {}, "unbounded"),
        ("llff", "fern", {}, "forward"),
        ("blender", "lego_400", {}, "bounded"),
    ],
)
def test_real_captures(ctm_data, layout, folder, settings, expected):
    assert DATASETS.get(layout)(root=ctm_data / folder, **settings).rig().geometry()[0] == expected
