"""Choice of a clip's frames: the sharpest of each window, windows of equal movement of the picture."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32
from skimage.registration import optical_flow_ilk

MIN_FRAMES, MAX_FRAMES = 40, 120
"""Least and largest number of frames chosen from all clips together, where there are as many."""
FRAME_MOVEMENT = 1 / 16
"""Movement from one chosen frame to the next, in longer sides of the picture."""
MIN_MOVEMENT = 0.1
"""Least movement, in longer sides, of a clip that shows more than one place."""
FLOW_SIDE = 80
"""Longer side in pixels of the frames whose movement is measured: averaging removes their noise."""
BASE_MOVEMENT = 0.02
"""Movement, in longer sides, after which it is measured from a new frame: a hand that shakes adds up to nothing."""
MIN_SHARPNESS = 0.5
"""Least sharpness of a chosen frame, as a share of its sharper neighbour's; less sharp ones are left out."""
MAX_STRIDE = 4
"""Most frames from one measurement of movement to the next."""


class Course(NamedTuple):
    """Sharpness and movement of a clip's frames.

    Attributes:
        moved: ``[N]`` length that the picture has moved until each frame, in its longer sides; it never falls.
        sharpness: ``[N]`` energy of the differences of neighbouring pixels, to compare frames of the same things.
    """

    moved: Float[np.ndarray, " n"]
    sharpness: Float[np.ndarray, " n"]


def course(frames: Iterable[Float32[np.ndarray, "h w"]]) -> Course:
    """Measure sharpness and movement of grey frames ``[H, W]``, of which three are held at a time.

    Movement is the median length of the optical flow from a base frame, a new one after each ``BASE_MOVEMENT``.
    """
    sharpness, measured, moved = [], [0], [0.0]
    first, base, stride = None, 0.0, 1
    for number, frame in enumerate(frames):
        sharpness.append(_sharpness(frame))
        if first is None:
            first = _small(frame)
        elif number >= measured[-1] + stride:
            small = _small(frame)
            flow = optical_flow_ilk(first, small, radius=5, num_warp=3)
            far = float(np.median(np.hypot(*flow))) / max(small.shape)
            fast = base + far - moved[-1] > BASE_MOVEMENT / 2
            stride = max(stride // 2, 1) if fast else min(stride + 1, MAX_STRIDE)
            measured.append(number)
            moved.append(max(base + far, moved[-1]))
            if far > BASE_MOVEMENT:
                first, base = small, moved[-1]
    numbers = np.arange(len(sharpness))
    return Course(np.interp(numbers, measured, moved) if sharpness else np.zeros(0), np.array(sharpness))


def choose(courses: Sequence[Course]) -> list[list[int]]:
    """Choose frames of clips: indices from 0, by clip; none of a clip that does not move.

    Each is the sharpest of a window of equal movement. All clips have ``MIN_FRAMES`` to ``MAX_FRAMES`` windows, rounded
    for each clip; a window whose sharpest frame is far blurrier than its neighbours' gives none.
    """
    lengths = [each.moved[-1] if len(each.moved) and each.moved[-1] >= MIN_MOVEMENT else 0.0 for each in courses]
    count = np.clip(round(sum(lengths) / FRAME_MOVEMENT), MIN_FRAMES, MAX_FRAMES)
    return [
        _sharpest(each, max(round(count * length / sum(lengths)), 1)) if length else []
        for each, length in zip(courses, lengths, strict=True)
    ]


def _sharpest(course: Course, count: int) -> list[int]:
    """The sharpest frame of each of ``count`` windows; none where it is blurred next to its neighbour's."""
    window = np.minimum(course.moved / course.moved[-1] * count, count - 1).astype(int)
    starts = np.flatnonzero(np.diff(window, prepend=-1))
    parts = np.split(course.sharpness, starts[1:])
    best = np.array([start + part.argmax() for start, part in zip(starts, parts, strict=True)])
    near = np.pad(course.sharpness[best], 1)
    return best[near[1:-1] >= MIN_SHARPNESS * np.maximum(near[:-2], near[2:])].tolist()


def _sharpness(frame: Float32[np.ndarray, "h w"]) -> float:
    return float(np.square(frame[2:] - frame[:-2]).mean() + np.square(frame[:, 2:] - frame[:, :-2]).mean())


def _small(frame: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "i j"]:
    """A frame averaged to ``FLOW_SIDE``, scaled to deviation 1, so that movement is found alike in dark and light."""
    factor = max(max(frame.shape) // FLOW_SIDE, 1)
    height, width = (side // factor for side in frame.shape)
    small = frame[: height * factor, : width * factor].reshape(height, factor, width, factor).mean((1, 3))
    return (small - small.mean()) / max(small.std(), 1e-6)
