"""What each kind of appearance is: at first nothing, always the identity in the mean, undone exactly."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pictures import place, views
from tolerance import assert_within, of_functions

from ctm_plugin.appearance.affine import Affine, inverted
from ctm_plugin.appearance.bilateral import Bilateral
from ctm_plugin.appearance.exposure import Exposure
from ctm_plugin.errors import ConfigError

KINDS = [Exposure, Affine, Bilateral]
COUNT = 5


def made(kind: type, spread: float = 0.0, **settings):
    """One with parameters from a normal distribution, of five dark pictures."""
    pictures = views(torch.arange(COUNT * 48, dtype=torch.uint8).view(COUNT, 4, 4, 3) % 40)
    found = kind(kind.Config(**{"start": "same"} | settings), pictures)
    draw = torch.Generator().manual_seed(0)
    for parameter in found.parameters():
        parameter.data += spread * torch.randn(parameter.shape, generator=draw)
    return found.requires_grad_(False)


def colors(rows: int = 300) -> torch.Tensor:
    return torch.rand(rows, 3, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("kind", KINDS)
def test_at_first_the_identity_and_always_undone(kind):
    found, light, there = made(kind, 0.1), colors() / 10, place(COUNT, colors())
    assert torch.equal(made(kind)(light, there), light)
    changed = found(light, there)
    assert (changed - light).abs().max() > 0.01
    torch.testing.assert_close(found.undone(changed, there), light, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_the_pictures_mean_is_the_identity_whatever_is_learned(kind):
    """The logarithms of gains add up to 0; matrices and grids have the identity as their mean."""
    found = made(kind, 2.0)
    assert float(found.log_gains().sum()) == pytest.approx(0, abs=1e-5)
    if kind is Affine:
        torch.testing.assert_close(found.matrices().mean(0), torch.eye(3), atol=1e-5, rtol=0)
    if kind is Bilateral:
        assert found.grids().mean(0).abs().max() < 1e-5


def test_a_grid_is_looked_up_trilinearly_in_its_own_picture():
    """Against torch's grid_sample, a picture at a time."""
    found = made(Bilateral, 0.1, across=6, levels=3)
    there = place(COUNT, colors() / 8)
    matrices, offsets = found.maps(there)
    shade = (there.rendered * found.luminance).sum(-1).clamp(0, 1)
    assert 0.1 < shade.quantile(0.25) < shade.quantile(0.75) < 1
    at = 2 * torch.cat([there.at, shade[:, None]], 1) - 1
    for picture, grid in enumerate(found.grids().view(COUNT, 3, 6, 6, 12)):
        mine = there.view == picture
        volume = grid.permute(3, 0, 1, 2)[None]
        sliced = torch.nn.functional.grid_sample(volume, at[mine].view(1, 1, 1, -1, 3), align_corners=True)
        expected = sliced.view(3, 4, -1).permute(2, 0, 1)
        torch.testing.assert_close(matrices[mine] - torch.eye(3), expected[..., :3], atol=1e-5, rtol=0)
        torch.testing.assert_close(offsets[mine], found.light * expected[..., 3], atol=1e-5, rtol=0)


def test_what_regularises():
    """The distance from the identity; squared differences of neighbours along each side, none of a constant grid."""
    affine = made(Affine, 0.3, identity=2.0)
    expected = 2 * (affine.matrices() - torch.eye(3)).square().mean()
    torch.testing.assert_close(affine.regularisers()["balance"], expected)
    assert made(Affine, identity=0.0).regularisers() == made(Exposure).regularisers() == {}
    grid = made(Bilateral, across=6, levels=3, smooth=2.0)
    grid.grid.data += torch.arange(COUNT)[:, None, None]
    assert float(grid.regularisers()["smooth"]) == 0
    levels = torch.arange(3.0)[:, None].expand(3, 36).flatten()
    grid.grid.data += 0.5 * levels[:, None]
    assert float(grid.regularisers()["smooth"]) == pytest.approx(2 * 0.25)


@given(st.integers(0, 10**6))
def test_inverses(seed):
    draw = torch.Generator().manual_seed(seed)
    matrices = torch.eye(3) + 0.2 * (torch.rand(4, 3, 3, generator=draw) - 0.5)
    torch.testing.assert_close(inverted(matrices) @ matrices, torch.eye(3).expand(4, 3, 3), atol=1e-5, rtol=0)
    assert inverted(0 * matrices).isfinite().all()  # flat ones, too


def test_exposures_start_from_the_light():
    """Pictures times 1, 2, 4: the logarithms of their means lie ln 2 apart; masked and clear pixels have no part."""
    image = torch.linspace(0.001, 0.003, 48).view(4, 4, 3)  # where sRGB's curve is a line
    images = torch.stack([image, 2 * image, 4 * image])
    mask = torch.ones(3, 4, 4, dtype=torch.bool)
    mask[:, 0, 0] = False
    images[2, 0, 0] = 1.0
    found = Exposure(Exposure.Config(start="light"), views(images, mask=mask))
    expected = torch.tensor([-1.0, 0, 1]) * math.log(2)
    torch.testing.assert_close(found.log_gains().detach(), expected, atol=1e-5, rtol=0)
    alpha = torch.cat([images, mask[..., None].float()], -1)
    same = Exposure(Exposure.Config(start="light"), views(alpha))
    assert_within(same.log_gain.detach(), found.log_gain.detach(), of_functions(found.log_gain.detach()))
    black = Exposure(Exposure.Config(start="light"), views(torch.zeros(3, 4, 4, 3)))
    assert torch.equal(black.log_gains(), torch.zeros(3))


@pytest.mark.parametrize("fixed", [False, True])
def test_exposures_start_from_exif(fixed):
    pictures = views(torch.zeros(3, 4, 4, 3), exposures=torch.tensor([0.01, 0.04, 0.02]))
    found = Exposure(Exposure.Config(start="exif", fixed=fixed), pictures)
    torch.testing.assert_close(found.log_gains().exp().detach(), torch.tensor([0.5, 2.0, 1.0]))
    assert (found.optimizer(10) is None) == fixed
    assert list(found.state_dict()) == ["log_gain"]
    assert found.describe() == "exposures from -1.00 to +1.00 stops"


@pytest.mark.parametrize(
    ("exposures", "found"),
    [(None, "3 of 3 have none, as p0"), (torch.tensor([0.1, torch.nan, 0.2]), "1 of 3 have none, as p1")],
)
def test_exif_that_does_not_tell(exposures, found):
    with pytest.raises(ConfigError, match=rf"appearance\.start: found 'exif', expected pictures whose EXIF .* {found}"):
        Exposure(Exposure.Config(start="exif"), views(torch.zeros(3, 4, 4, 3), exposures=exposures))
