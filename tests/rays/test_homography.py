"""Homographies against the laws of their group, scipy's matrix exponential and scikit-image's warps."""

import math

import numpy as np
import pytest
import scipy.linalg
import torch
from hypothesis import given
from hypothesis import strategies as st
from skimage.transform import ProjectiveTransform
from tolerance import assert_within, gamma, of_sums

from ctm_plugin.rays.homography import patch_corners, pixel_grid, sl3_exp, to_pixels, warp

NUMBERS = st.floats(-0.7, 0.7).filter(lambda v: v == 0 or abs(v) > 1e-6)
PARAMETERS = st.lists(NUMBERS, min_size=8, max_size=8)


def double(numbers) -> torch.Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


def test_zero_is_the_identity():
    """Exactly: products with 0 and 1."""
    assert torch.equal(sl3_exp(torch.zeros(2, 8)), torch.eye(3).expand(2, 3, 3))


@given(PARAMETERS)
def test_exponential_of_the_generator(h):
    h1, h2, h3, h4, h5, h6, h7, h8 = h
    generator = np.array([[h5, h3, h1], [h4, -h5 - h6, h2], [h7, h8, h6]])
    matrix = sl3_exp(double(h))
    torch.testing.assert_close(matrix, torch.from_numpy(scipy.linalg.expm(generator)), atol=1e-12, rtol=1e-9)
    assert matrix.det().item() == pytest.approx(1, abs=1e-9)


@given(PARAMETERS, st.floats(-1, 1), st.floats(-1, 1))
def test_one_parameter_subgroups(h, s, t):
    h = double(h)
    torch.testing.assert_close(sl3_exp(s * h) @ sl3_exp(t * h), sl3_exp((s + t) * h), atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(sl3_exp(h) @ sl3_exp(-h), torch.eye(3, dtype=torch.float64), atol=1e-9, rtol=0)


@pytest.mark.parametrize(
    ("h", "moved"),
    [
        ([0.3, -0.2, 0, 0, 0, 0, 0, 0], (0.5 + 0.3, 0.25 - 0.2)),
        ([0, 0, 0.4, 0, 0, 0, 0, 0], (0.5 + 0.4 * 0.25, 0.25)),
        ([0, 0, 0, 0.4, 0, 0, 0, 0], (0.5, 0.25 + 0.4 * 0.5)),
        ([0, 0, 0, 0, 0.1, 0, 0, 0], (0.5 * math.exp(0.1), 0.25 * math.exp(-0.1))),
        ([0, 0, 0, 0, 0, 0.1, 0, 0], (0.5 * math.exp(-0.1), 0.25 * math.exp(-0.2))),
        ([0, 0, 0, 0, 0, 0, 0.2, 0], (0.5 / 1.1, 0.25 / 1.1)),
        ([0, 0, 0, 0, 0, 0, 0, 0.2], (0.5 / 1.05, 0.25 / 1.05)),
    ],
)
def test_what_each_parameter_does(h, moved):
    torch.testing.assert_close(warp(double([[0.5, 0.25]]), sl3_exp(double(h))), double([moved]))


@given(PARAMETERS.map(lambda h: [v * min(1, 1.5 / (sum(map(abs, h)) or 1)) for v in h]))
def test_warps_are_scikit_images(h):
    points = double([[0.1, -0.4], [0.9, 0.3], [-0.7, -0.6], [0.0, 0.0]])
    matrix = sl3_exp(double(h))
    expected = torch.from_numpy(ProjectiveTransform(matrix.numpy())(points.numpy()))
    torch.testing.assert_close(warp(points, matrix), expected, atol=1e-9, rtol=1e-9)


def test_points_for_each_homography():
    h = double([[0.1] * 8, [0.0] * 8])
    shared, own = torch.rand(5, 2, dtype=torch.float64), torch.rand(2, 5, 2, dtype=torch.float64)
    matrix = sl3_exp(h)
    assert torch.equal(warp(shared, matrix)[1], shared)  # products with 0 and 1 are exact
    # Batched and alone are other products. Of x / w: a sum of three terms by one of three, and the quotient.
    found, alone = warp(own, matrix)[0], warp(own[0], matrix[0])
    sizes = own[0] @ matrix[0, :, :2].abs().T + matrix[0, :, 2].abs()
    w = (own[0] @ matrix[0, :, :2].T + matrix[0, :, 2])[:, 2:].abs()
    of_sum = of_sums(sizes, 3) / w
    assert_within(found, alone, of_sum[:, :2] + alone.abs() * (of_sum[:, 2:] + of_sums(torch.ones(()).double(), 2)))
    # A series of 18 powers at most, each a product of three terms and an addition: all sizes add up to exp(|A|).
    alone = sl3_exp(h[0])
    size = torch.linalg.matrix_exp(h.new_tensor([[0.1, 0.1, 0.1], [0.1, 0.2, 0.1], [0.1, 0.1, 0.1]]))
    assert_within(matrix[0], alone, 2 * gamma(4 * 18, torch.float64) * size)


def test_gradients():
    points, h = torch.rand(4, 2, dtype=torch.float64), double([0.1, -0.2, 0.1, 0.05, -0.1, 0.1, 0.2, -0.1])
    assert torch.autograd.gradcheck(
        lambda p, h: warp(p, sl3_exp(h)), (points.requires_grad_(), h.requires_grad_()), atol=1e-6
    )


def test_pixel_grid_by_hand():
    grid = pixel_grid(2, 4)
    assert grid[..., 0].tolist() == [[-0.75, -0.25, 0.25, 0.75]] * 2
    assert grid[..., 1].tolist() == [[-0.25] * 4, [0.25] * 4]
    assert torch.equal(pixel_grid(2, 4, 2), grid[:, 1:3])


@pytest.mark.parametrize(("height", "width", "patch"), [(360, 480, 180), (10, 7, 3), (8, 8, 8)])
def test_patches_lie_in_the_middle(height, width, patch):
    """The same pixels to the bit: each coordinate is rounded by one division alone."""
    grid = pixel_grid(height, width)
    top, left = height // 2 - patch // 2, width // 2 - patch // 2
    assert torch.equal(pixel_grid(height, width, patch), grid[top : top + patch, left : left + patch])
    corners = to_pixels(patch_corners(height, width, patch), height, width)
    expected = [[left, top], [left, top + patch], [left + patch, top + patch], [left + patch, top]]
    torch.testing.assert_close(corners, torch.tensor(expected, dtype=torch.float32), atol=1e-4, rtol=0)


def test_pixels_of_the_grid():
    pixels = to_pixels(pixel_grid(3, 5), 3, 5)
    torch.testing.assert_close(pixels[2, 4], torch.tensor([4.5, 2.5]))
    torch.testing.assert_close(pixels[0, 0], torch.tensor([0.5, 0.5]))
