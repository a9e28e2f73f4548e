"""Splats by loops against plain torch in float64, which tests/splats holds to the formula."""

import math

import pytest
import torch
from gaussian_scenes import DOUBLE, FLOOR, SETTINGS, Setting, alphas, both_ways, certain, close, setting
from torch import Tensor

from ctm_plugin.cpu.splat_projection import GEOMETRY, project
from ctm_plugin.cpu.splats import TILE_HEIGHT, TILE_WIDTH, binned, draw, packed
from ctm_plugin.splats.gaussians import Gaussians
from ctm_plugin.splats.render import INVERSE_CHANNELS, PLANE_CHANNELS, picture


@pytest.mark.parametrize("name", SETTINGS)
def test_picture_and_gradients(name):
    of = SETTINGS[name]
    counts = certain(of.projected(), of.camera, 2e-3)
    assert counts.double().mean() > 0.6
    found, expected = both_ways(of, counts)
    assert expected["means"].any()
    close(found, expected, counts, 2e-5 if name not in ("needles", "discs") else 2e-4)


@pytest.mark.parametrize("lens", [False, True])
def test_inverse_depth_has_gradients(lens):
    of = setting(40, lens=lens)
    counts = certain(of.projected(), of.camera, 2e-3)
    close(*both_ways(of, counts, INVERSE_CHANNELS), counts, 2e-5)


@pytest.mark.parametrize("name", ["through a lens", "of five channels and all harmonics", "discs"])
def test_depth(name):
    of = SETTINGS[name]
    counts = certain(of.projected(), of.camera, 2e-3)
    found, expected = (
        of.rendered(run, dtype, PLANE_CHANNELS)[2].detach()
        for run, dtype in ((picture, torch.float32), (picture.reference, DOUBLE))
    )
    assert found.shape[0] == of.gaussians.sh0.shape[1] + PLANE_CHANNELS
    apart = (found.double() - expected).abs() * counts
    bound = expected.abs().amax((1, 2), keepdim=True)
    assert (apart <= (2e-5 if name != "discs" else 1e-3) * bound).all()


def test_pictures_with_depth_have_no_gradients():
    _, _, image, _ = setting(5).rendered(picture, torch.float32, PLANE_CHANNELS)
    with pytest.raises(NotImplementedError, match="gradients of pictures with depth"):
        image.sum().backward()


def test_many_opaque_layers():
    """Tiles are left once next to no light passes: what lies behind would add a ten thousandth."""
    of = setting(400, width=40, height=40, sizes=(0.0, 0.0, 0.0), opacity=4.0)
    counts = certain(of.projected(), of.camera, 2e-3)
    found, expected = both_ways(of, counts)
    assert expected["left"].max() < 1e-3
    close(found, expected, counts, 2e-3)  # what is left out pulls at opacities, by a share of little
    flat, (owner, _, _, tiles), colors = listed(of)
    image, left, ends = torch.empty(3, 40, 40), torch.empty(40, 40), torch.empty(len(tiles) - 1, dtype=torch.int64)
    draw(tiles, owner, flat, colors, -(-40 // TILE_WIDTH), image, left, ends)
    assert (ends - tiles[:-1]).sum() < 0.5 * len(owner)  # most of the lists are not gone through


def listed(of: Setting) -> tuple[Tensor, tuple[Tensor, ...], Tensor]:
    """Gaussians on the picture, the lists of the tiles, colours."""
    tables = [each.contiguous() for each in of.gaussians]
    count, k = tables[4].shape
    flat, basis, colors = (torch.empty(count, wide) for wide in (GEOMETRY, of.degrees**2, k))
    numbers = packed(of.camera, FLOOR)
    project(*tables, torch.zeros(count, 2), numbers, of.degrees, flat, basis, colors)
    return flat, binned(flat, -(-of.camera.width // TILE_WIDTH), -(-of.camera.height // TILE_HEIGHT)), colors


@pytest.mark.parametrize("seed", range(3))
def test_needles_are_in_the_lists_of_the_tiles_that_they_reach(seed):
    """Of every tile where one changes a pixel; and of few others, as squares round slanted ones would be."""
    of = setting(80, sizes=(1.0, -4.0, -5.0), width=160, height=96, seed=seed, opacity=2.0)
    found, y, x = of.projected(), torch.arange(96)[:, None] + 0.5, torch.arange(160) + 0.5
    dx, dy = (at - mean[:, None, None] for at, mean in zip((x, y), found.means.T, strict=True))
    wide, high = found.extents.T[..., None, None]
    here, around = (
        each.view(80, 96 // TILE_HEIGHT, TILE_HEIGHT, 160 // TILE_WIDTH, TILE_WIDTH).any(4).any(2).flatten(1)
        for each in (alphas(found, of.camera) > 1.01 / 255, (dx.abs() < wide) & (dy.abs() < high))
    )
    owner, _, _, tiles = listed(of)[1]
    ours = torch.zeros_like(here)
    ours[owner.long(), torch.arange(len(tiles) - 1).repeat_interleave(tiles.diff())] = True
    assert not (here & ~ours).any()
    assert len(owner) == ours.sum() < 1.1 * here.sum()
    assert around.sum() > 1.5 * here.sum()


@pytest.mark.parametrize("threads", [2, 3])
def test_any_number_of_threads(threads):
    """To the bit: a tile, and a Gaussian, is one thread's, and sums have one order."""
    of, found, before = setting(300, lens=True, width=90, height=70), [], torch.get_num_threads()
    for count in (1, threads):
        torch.set_num_threads(count)
        try:
            tables, shift, image, left = of.rendered(picture, torch.float32)
            (image.square().sum() + left.sin().sum()).backward()
            found.append([image, left, shift.grad, *(each.grad for each in tables)])
        finally:
            torch.set_num_threads(before)
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))


@pytest.mark.parametrize(
    ("field", "value"),
    [("means", math.nan), ("means", 1e30), ("scales", math.nan), ("quats", math.nan), ("opacities", math.nan)],
)
def test_what_is_no_number_is_not_shown(field, value):
    """Nor does it end the process, as a place in no tile would."""
    of = setting(40)
    table = getattr(of.gaussians, field).clone()
    table[7:9] = value
    rest = Gaussians(*(torch.cat([each[:7], each[9:]]) for each in of.gaussians))
    spoilt = of._replace(gaussians=of.gaussians._replace(**{field: table}))
    *_, image, left = spoilt.rendered(picture, torch.float32)
    *_, expected, expected_left = of._replace(gaussians=rest).rendered(picture, torch.float32)
    assert torch.equal(image, expected)
    assert torch.equal(left, expected_left)
