"""The browser's camera against closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ctm_plugin.scene.camera_paths import focus
from ctm_plugin.scene.views import Scene, Views
from ctm_plugin.view.camera import BrowserCamera, ahead

ORIGIN = (0.0, 0.0, 0.0)
LEVEL = (1.0, 0.0, 0.0, 0.0)
UPSIDE = (0.0, 1.0, 0.0, 0.0)
"""OpenCV's camera turned half round x: y up, looking along -z."""


def test_opencv_becomes_opengl():
    # Unturned, OpenCV's camera looks along z, its y down: right is x, up -y, back -z.
    camera = BrowserCamera(LEVEL, (1.0, 2.0, 3.0), 1.0, 1.5)
    expected = torch.tensor([[1.0, 0, 0, 1], [0, -1, 0, 2], [0, 0, -1, 3]])
    torch.testing.assert_close(camera.c2w, expected, atol=1e-7, rtol=0)
    torch.testing.assert_close(BrowserCamera(UPSIDE, ORIGIN, 1.0, 1.5).c2w, torch.eye(3, 4), atol=1e-7, rtol=0)


@given(st.integers(0, 10**6), st.floats(0.1, 3.0), st.floats(0.2, 5.0))
def test_the_axis_and_the_corners(seed, fov, aspect):
    """The middle ray goes forward; rays through the edges' middles and the corners have the field of view."""
    turn = Rotation.random(rng=np.random.default_rng(seed))
    camera = BrowserCamera(tuple(np.roll(turn.as_quat(), 1)), (1.0, -2.0, 3.0), fov, aspect)
    right, down, forward = turn.as_matrix().T
    rays = camera.rays(3, 5)
    assert (rays.origins == torch.tensor([1.0, -2, 3])).all()
    directions = rays.directions.double().numpy().reshape(3, 5, 3)
    np.testing.assert_allclose(directions[1, 2], forward, atol=1e-6)
    half = math.tan(fov / 2)
    # Pixel centres: rows at -2/3, 0, 2/3 of the half height, columns at -4/5 ... 4/5 of the half width.
    for row, y in ((0, -2 / 3), (2, 2 / 3)):
        for column, x in ((0, -4 / 5), (4, 4 / 5)):
            corner = forward + y * half * down + x * half * aspect * right
            np.testing.assert_allclose(directions[row, column], corner / np.linalg.norm(corner), atol=1e-5)


@pytest.mark.parametrize(
    ("aspect", "size"), [(1.0, (64, 64)), (2.0, (32, 64)), (0.5, (64, 32)), (16 / 9, (36, 64)), (1e-9, (64, 1))]
)
def test_sizes(aspect, size):
    assert BrowserCamera(LEVEL, ORIGIN, 1.0, aspect).size(64) == size


@pytest.mark.parametrize(
    ("change", "usable"),
    [
        ({}, True),
        ({"wxyz": (math.nan, 0.0, 0.0, 0.0)}, False),
        ({"wxyz": (0.0, 0.0, 0.0, 0.0)}, False),
        ({"position": (math.inf, 0.0, 0.0)}, False),
        ({"fov": 0.0}, False),
        ({"fov": math.pi}, False),
        ({"fov": math.nan}, False),
        ({"aspect": 0.0}, False),
        ({"aspect": math.nan}, False),
        ({"aspect": 1e300}, False),
    ],
)
def test_what_is_a_camera(change, usable):
    assert replace(BrowserCamera(LEVEL, ORIGIN, 1.0, 1.0), **change).usable() == usable


def scene(geometry: str, c2w: torch.Tensor) -> Scene:
    count = len(c2w)
    images = torch.zeros(count, 4, 4, 3, dtype=torch.uint8)
    views = Views(images, c2w, torch.ones(count, 4), tuple(map(str, range(count))))
    return Scene("a scene", views, views, near=1.0, far=9.0, geometry=geometry, background="black")


def test_what_it_turns_round():
    """As deep as what cameras on two sides look at; as the spiral's focus where they look the same way."""
    front, side = torch.eye(3, 4), torch.tensor([[0.0, 0, 1, 4], [0, 1, 0, 0], [-1, 0, 0, 0]])
    front[2, 3] = 5.0
    bounded = scene("bounded", torch.stack([front, side]))
    np.testing.assert_allclose(ahead(bounded, front[None])[0], [0, 0, 0], atol=1e-5)
    aside = front.clone()
    aside[0, 3] = 0.5
    np.testing.assert_allclose(ahead(bounded, aside[None])[0], [0.5, 0, 0], atol=1e-5)
    away = front * torch.tensor([-1.0, 1, -1, 1])  # looks the other way: what it turns round is in front of it
    np.testing.assert_allclose(ahead(bounded, away[None])[0], [0, 0, 6], atol=1e-5)
    np.testing.assert_allclose(
        ahead(scene("forward", front[None]), front[None])[0], [0, 0, 5 - focus(1.0, 9.0)], atol=1e-5
    )
