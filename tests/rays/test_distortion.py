"""OpenCV's lens distortion: against its formula written out in float64, and back again."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.data.readers.lens import Intrinsics, check_lens
from ctm_plugin.errors import DataError
from ctm_plugin.rays.cameras import camera_rays, distort, distortion_slopes, pixel_rays, undistort
from ctm_plugin.scene.frustum import frustum_box, view_counts, widest
from ctm_plugin.scene.views import Views

HEIGHT, WIDTH = 6, 8
PHONE = (0.08, -0.15, 0.001, -0.0005, 0.05)
WIDE = (-0.28, 0.09, -0.0008, 0.0003, -0.012)

LENS = st.tuples(*(st.floats(-bound, bound) for bound in (0.2, 0.05, 0.003, 0.003, 0.01)))
"""Photographic lenses, barrels and cushions; none folds up to a radius of 1, undistorted."""


def by_hand(x: float, y: float, lens) -> tuple[float, float]:
    """The formula of OpenCV's manual, "Camera Calibration and 3D Reconstruction"."""
    k1, k2, p1, p2, k3 = lens
    r = math.hypot(x, y)
    radial = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6
    return x * radial + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2), y * radial + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y


def points(seed: int, count: int = 64, reach: float = 0.6) -> tuple[torch.Tensor, torch.Tensor]:
    return tuple(torch.from_numpy(np.random.default_rng(seed).uniform(-reach, reach, (2, count))))


def lens_views(lens=WIDE, focal: float = 8.0, count: int = 2) -> Views:
    c2w = torch.eye(3, 4).repeat(count, 1, 1)
    c2w[:, 0, 3] = torch.arange(count)
    return Views(
        torch.zeros(count, HEIGHT, WIDTH, 3, dtype=torch.uint8),
        c2w,
        torch.tensor([[focal, focal * 0.9, WIDTH / 2, HEIGHT / 2]]).repeat(count, 1),
        tuple(map(str, range(count))),
        distortion=torch.tensor([lens]).repeat(count, 1),
    )


@given(LENS, st.integers(0, 10**6))
def test_the_manuals_formula(lens, seed):
    x, y = points(seed)
    out = torch.stack(distort(x, y, torch.tensor(lens, dtype=torch.float64)))
    expected = np.array([by_hand(*at, lens) for at in zip(x.tolist(), y.tolist(), strict=True)]).T
    np.testing.assert_allclose(out, expected, atol=1e-14)


@given(LENS, st.integers(0, 10**6))
def test_slopes_are_the_derivative(lens, seed):
    x, y = (value.requires_grad_() for value in points(seed, 8))
    lens = torch.tensor(lens, dtype=torch.float64)
    xx, xy, yy = distortion_slopes(x, y, lens)
    for out, expected in zip(distort(x, y, lens), ((xx, xy), (xy, yy)), strict=True):
        torch.testing.assert_close(torch.autograd.grad(out.sum(), (x, y), retain_graph=True), expected)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-6)])
@given(lens=LENS, seed=st.integers(0, 10**6))
def test_there_and_back(dtype, tolerance, lens, seed):
    x, y = (value.to(dtype) for value in points(seed))
    each = torch.tensor(lens, dtype=dtype).expand(len(x), 5)
    torch.testing.assert_close(undistort(*distort(x, y, each), each), (x, y), atol=tolerance, rtol=0)


@pytest.mark.parametrize("lens", [PHONE, WIDE])
def test_rays_of_a_lens(lens):
    """A point is imaged by hand: pose, pinhole, lens, pixels. The ray through that image point passes the point."""
    fx, fy, cx, cy = 100.0, 90.0, 42.0, 31.0
    # The camera at (1, 2, 3) looks along -x, its right is -z.
    c2w = torch.tensor([[[0.0, 0, 1, 1], [0, 1, 0, 2], [-1, 0, 0, 3]]])
    for right, up, depth in ((0.5, 0.3, 2.0), (-1.0, 0.9, 3.0), (0.1, -2.0, 4.0)):
        u, v = by_hand(right / depth, -up / depth, lens)
        x, y = torch.tensor([cx + fx * u]), torch.tensor([cy + fy * v])
        rays = camera_rays(c2w, torch.tensor([[fx, fy, cx, cy]]), x, y, torch.tensor([lens]))
        point = torch.tensor([1 - depth, 2 + up, 3 - right])
        away = point - rays.origins[0]
        torch.testing.assert_close(away / away.norm(), rays.directions[0], atol=2e-6, rtol=0)


def test_box_holds_what_a_lens_sees():
    """A barrel's corners see further aside than a pinhole's."""
    views = lens_views(count=1)
    low, high = frustum_box(views, 1.0, 4.0)
    rays = pixel_rays(views.c2w, views.intrinsics, HEIGHT, WIDTH, torch.arange(HEIGHT * WIDTH), views.distortion)
    ends = torch.cat([rays.origins + t * rays.directions for t in (1.0, 4.0)])
    assert ((ends >= low - 1e-5) & (ends <= high + 1e-5)).all()
    barrel = undistort(torch.tensor(0.5), torch.tensor(0.0), torch.tensor(WIDE))[0].item()
    assert high[0] == pytest.approx(4 * barrel / math.hypot(1, barrel), rel=1e-3)
    u, v = undistort(torch.tensor(0.5), torch.tensor(3 / 7.2), torch.tensor(WIDE))
    assert widest(views) == pytest.approx(math.hypot(1, u.item(), v.item()), rel=1e-3)


@given(st.integers(0, 10**6))
def test_counts_through_a_lens(seed):
    views = lens_views()
    grid = torch.rand(200, 3, generator=torch.Generator().manual_seed(seed)) * torch.tensor([12.0, 12, 4]) - 6
    counts, _ = view_counts(grid, views, 0.1)
    for point, count in zip(grid.tolist(), counts.tolist(), strict=True):
        seen, doubtful = 0, False
        for eye in (0.0, 1.0):
            u, v = (point[0] - eye) / -point[2], point[1] / point[2]
            if point[2] >= 0 or math.hypot(u, v) > 1.2:  # no lens of this kind sees that far aside
                continue
            u, v = by_hand(u, v, WIDE)
            column, row = WIDTH / 2 + 8 * u, HEIGHT / 2 + 7.2 * v
            margin = min(column, WIDTH - column, row, HEIGHT - row)
            seen += margin >= 0
            doubtful |= abs(margin) < 1e-3
        assert doubtful or count == seen


def test_points_that_the_polynomial_folds_into_the_image_are_not_seen():
    views = lens_views((-0.3, 0.0, 0.0, 0.0, 0.0), count=1)
    u = math.sqrt(1 / 0.3)  # u (1 - 0.3 u²) = 0: the middle of the image
    counts, _ = view_counts(torch.tensor([[0.0, 0, -1], [u, 0, -1]]), views, 0.1)
    assert counts.tolist() == [1, 0]


@given(LENS)
def test_photographic_lenses_pass(lens):
    check_lens(Intrinsics(800, 600, 800.0, 800.0, 400.0, 300.0, lens, "camera 1"), Path("cameras.bin"))


@pytest.mark.parametrize(
    "lens", [(-1.2, 0, 0, 0, 0), (0, -5.0, 0, 0, 0), (0, 0, 2.0, 0, 0), (1e6, -1e6, 0, 0, 0), (-2.0, 3.0, 0, 0, -8.0)]
)
def test_lenses_that_fold(lens):
    with pytest.raises(DataError, match=r"cameras\.bin: found camera 1 with distortion .*expected a lens that maps on"):
        check_lens(Intrinsics(800, 600, 500.0, 500.0, 400.0, 300.0, lens, "camera 1"), Path("cameras.bin"))
