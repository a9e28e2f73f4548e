"""Averaged pictures, and how long each size of them teaches something."""

import dataclasses

import pytest
import torch
from gaussian_scenes import LENS, views_of

from ctm_plugin.rays.cameras import pixel_rays
from ctm_plugin.scene.views import Views
from ctm_plugin.splats.coarse_to_fine import MIN_SIDE, OCTAVES, SIDES, STAGE_POWER, averaged, stages

SIDE = SIDES[0] * MIN_SIDE


def views_with(images: torch.Tensor, mask: torch.Tensor | None = None) -> Views:
    count, height, width, _ = images.shape
    views = views_of(torch.eye(3, 4).repeat(count, 1, 1), (60.0, 70.0, 31.0, 20.0), width, height, None)
    return dataclasses.replace(views, images=images, mask=mask)


def uniform(*shape: int) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(0))


# How long


def test_of_noise_each_octave_has_a_quarter_of_the_next():
    """Means over squares of s pixels have 1 / s of its deviation, and frequencies are weighed by 1 / s again."""
    found = stages(views_with(uniform(2, SIDE, SIDE, 3)))
    quarters = torch.tensor(0.25) ** torch.arange(OCTAVES)
    expected = {side: float(quarters[at:].sum() / quarters.sum()) ** STAGE_POWER for side, at in ((4, 2), (2, 1))}
    assert {stage.side: stage.until for stage in found} == pytest.approx(expected, rel=0.02)


def test_of_a_slope_each_octave_has_as_much():
    slope = torch.linspace(0, 1, SIDE)[None, :, None].expand(1, SIDE, SIDE, 3).contiguous()
    expected = {4: (3 / 5) ** STAGE_POWER, 2: (4 / 5) ** STAGE_POWER}
    assert {stage.side: stage.until for stage in stages(views_with(slope.transpose(1, 2)))} == pytest.approx(expected)


def test_smaller_pictures_come_first_and_the_exposure_changes_nothing():
    views = views_with(uniform(3, SIDE, SIDE, 3))
    found = stages(views)
    assert [stage.side for stage in found] == [*SIDES]
    assert 0 < found[0].until < found[1].until < 1
    dark = stages(dataclasses.replace(views, images=0.01 * views.images))
    assert [stage.until for stage in dark] == pytest.approx([stage.until for stage in found], rel=1e-5)


def test_where_there_is_nothing_to_learn_from_smaller_ones():
    assert stages(views_with(uniform(2, 2 * MIN_SIDE - 1, SIDE, 3))) == []
    assert [stage.side for stage in stages(views_with(uniform(2, SIDE - 1, SIDE, 3)))] == [2]
    assert all(stage.until == 0 for stage in stages(views_with(torch.full((1, SIDE, SIDE, 3), 0.5))))


def test_each_picture_keeps_a_square_that_counts():
    mask = torch.ones(2, SIDE, SIDE, dtype=torch.bool)
    mask[1] = False
    mask[1, 2:4, 6:8] = True
    assert [stage.side for stage in stages(views_with(uniform(2, SIDE, SIDE, 3), mask))] == [2]
    mask[1, 2, 6] = False
    assert stages(views_with(uniform(2, SIDE, SIDE, 3), mask)) == []


# Averages


@pytest.mark.parametrize("side", SIDES)
def test_means_over_squares(side):
    levels = (255 * uniform(2, 13, 18, 3)).to(torch.uint8)
    small = averaged(views_with(levels), side)
    assert small.images.shape == (2, 13 // side, 18 // side, 3)
    expected = levels[1, side : 2 * side, :side].double().mean((0, 1)) / 255
    torch.testing.assert_close(small.images[1, 1, 0].double(), expected, atol=1e-6, rtol=0)


def test_colour_counts_as_much_as_it_is_there():
    images = uniform(1, 8, 8, 4)
    images[0, :4, :4, 3] = 0
    small = averaged(views_with(images), 4).images[0]
    colour, alpha = images[0, 4:, 4:, :3], images[0, 4:, 4:, 3:]
    torch.testing.assert_close(small[1, 1, :3], (colour * alpha).mean((0, 1)) / alpha.mean())
    torch.testing.assert_close(small[1, 1, 3], alpha.mean())
    assert small[0, 0].tolist() == [0, 0, 0, 0]


def test_squares_that_are_partly_masked_do_not_count():
    mask = torch.ones(1, 9, 9, dtype=torch.bool)
    mask[0, 3, 5] = False
    small = averaged(views_with(uniform(1, 9, 9, 3), mask), 2)
    assert small.mask.shape == (1, 4, 4)
    assert (~small.mask).nonzero().tolist() == [[0, 1, 2]]
    assert averaged(views_with(uniform(1, 9, 9, 3)), 2).mask is None


@pytest.mark.parametrize("lens", [None, LENS])
def test_its_rays_go_through_the_middle_of_squares(lens):
    """A square of odd side has a pixel in its middle."""
    views = views_of(torch.eye(3, 4)[None], (30.0, 31.0, 7.0, 6.0), 15, 12, lens)
    small = averaged(views, 3)
    of = [
        pixel_rays(each.c2w, each.intrinsics, each.height, each.width, torch.tensor([at]), each.distortion)
        for each, at in ((views, 7 * 15 + 10), (small, 2 * 5 + 3))
    ]
    torch.testing.assert_close(of[1].directions, of[0].directions)
