"""Errors of homographies by hand."""

import pytest
import torch
from skimage.transform import ProjectiveTransform

from ctm_plugin.metrics.alignment import corner_errors, warp_errors
from ctm_plugin.rays.homography import patch_corners, sl3_exp


def test_no_error():
    h = torch.randn(5, 8) * 0.1
    assert warp_errors(h, h).tolist() == [0] * 5
    assert corner_errors(h, h, 360, 480, 180).tolist() == [0] * 5


def test_a_translation_by_hand():
    h, true = torch.zeros(2, 8), torch.zeros(2, 8)
    h[1, :2] = torch.tensor([0.03, 0.04])
    torch.testing.assert_close(warp_errors(h, true), torch.tensor([0.0, 0.05]))
    # A unit is half of the longer side, 240 pixels.
    torch.testing.assert_close(corner_errors(h, true, 360, 480, 180), torch.tensor([0.0, 12.0]), atol=1e-4, rtol=0)


def test_corners_against_scikit_image():
    h, true = torch.randn(3, 8, generator=torch.Generator().manual_seed(0)).double() * 0.1, torch.zeros(3, 8).double()
    corners = patch_corners(30, 40, 12).double().numpy()
    for one, error in zip(h, corner_errors(h, true, 30, 40, 12), strict=True):
        moved = ProjectiveTransform(sl3_exp(one).numpy())(corners)
        assert error.item() == pytest.approx(((((moved - corners) * 20) ** 2).sum(1) ** 0.5).mean())
