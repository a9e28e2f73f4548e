"""How far a picture has moved, and which frames are chosen."""

import numpy as np
import pytest
from clips import pan, wall
from scipy.ndimage import uniform_filter1d, zoom

from ctm_plugin.data.clip_frames import FRAME_MOVEMENT, MAX_FRAMES, MIN_FRAMES, MIN_MOVEMENT, Course, choose, course


def grey(frames: list[np.ndarray], light: float = 1.0, noise: float = 0.0) -> list[np.ndarray]:
    """Frames ``[H, W]`` in [0, 1] with so much of the light, noise of so many levels of 255, and whole levels."""
    chance = np.random.default_rng(0)
    codes = [frame.mean(-1) * light + noise * chance.normal(size=frame.shape[:2]) for frame in frames]
    return [(each.round() / 255).astype(np.float32) for each in codes]


@pytest.mark.slow
@pytest.mark.parametrize(("light", "noise"), [(1.0, 0.0), (0.03, 0.5)])
@pytest.mark.parametrize("speed", [1, 3])
def test_movement_is_that_of_the_camera_in_the_dark_too(speed, light, noise):
    """60 columns of 80, at any speed."""
    moved = course(grey(pan(range(0, 61, speed)), light, noise)).moved
    assert moved[-1] == pytest.approx(60 / 80, rel=0.1)
    assert (np.diff(moved) >= 0).all()


def test_going_nearer_is_movement():
    """Towards the middle, where nothing goes to one side; by the median over the picture."""
    near = wall()[40:160, 100:260].mean(-1)
    frames = [zoom(near, 1 + 0.02 * step, order=1)[step : step + 90, step : step + 120] for step in range(12)]
    frames = [np.ascontiguousarray(each).astype(np.float32) / 255 for each in frames]
    assert course(frames).moved[-1] > 0.04


@pytest.mark.parametrize("noise", [0.0, 3.0])
def test_a_tripod_and_a_hand_that_shakes_go_nowhere(noise):
    shaking = pan(100 + np.array([0, 1, 0, -1] * 20))
    assert course(grey(shaking, 0.1, noise)).moved[-1] < MIN_MOVEMENT
    assert choose([course(grey(shaking, 0.1, noise))]) == [[]]


@pytest.mark.slow
def test_frames_are_apart_by_movement_and_not_by_the_clock():
    """The camera rests for 60 frames, and goes on twice as fast."""
    places = np.concatenate([np.arange(0, 120, 1), np.full(60, 120), np.arange(120, 320, 2)])
    (numbers,) = choose([course(grey(pan(places)))])
    assert len(numbers) == pytest.approx(320 / 80 / FRAME_MOVEMENT, abs=3)
    assert max(np.diff(places[numbers])) <= 2.2 * 80 * FRAME_MOVEMENT
    assert sum(120 < number < 179 for number in numbers) <= 2


@pytest.mark.slow
def test_the_sharpest_is_chosen():
    """Of five frames in a row one is not blurred by the camera's motion."""
    places = np.arange(0, 400)
    frames = grey(pan(places), 0.2, 0.3)
    sharp = np.arange(len(frames)) % 5 == 2
    frames = [frame if keep else uniform_filter1d(frame, 7, axis=1) for frame, keep in zip(frames, sharp, strict=True)]
    (numbers,) = choose([course(frames)])
    assert len(numbers) >= MIN_FRAMES - 2
    assert sharp[numbers].mean() > 0.95


@pytest.mark.parametrize(("length", "count"), [(0.5, MIN_FRAMES), (5.0, 80), (50.0, MAX_FRAMES)])
def test_clips_share_the_frames_by_how_far_they_go(length, count):
    def straight(length: float) -> Course:
        return Course(np.linspace(0, length, 500), np.ones(500))

    one, other, still = choose([straight(length / 4), straight(length * 3 / 4), straight(0.01)])
    assert len(one) + len(other) == count
    assert len(other) == 3 * len(one)
    assert still == []


def test_no_more_frames_than_there_are():
    assert choose([Course(np.linspace(0, 1, 9), np.ones(9))]) == [[*range(9)]]
    assert choose([Course(np.zeros(0), np.zeros(0))]) == [[]]
