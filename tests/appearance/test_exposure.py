"""What an exposure is: at first nothing, always one in the mean, undone exactly; and what it starts from."""

import math

import pytest
import torch
from pictures import place, views
from tolerance import assert_within, of_functions

from ctm_plugin.appearance.exposure import Exposure
from ctm_plugin.errors import ConfigError

COUNT = 5


def made(spread: float) -> Exposure:
    """One with gains from a log-normal distribution, of five dark pictures."""
    pictures = views(torch.arange(COUNT * 48, dtype=torch.uint8).view(COUNT, 4, 4, 3) % 40)
    found = Exposure(Exposure.Config(start="same"), pictures)
    found.log_gain.data += spread * torch.randn(COUNT, generator=torch.Generator().manual_seed(0))
    return found.requires_grad_(False)


def test_at_first_the_identity_and_always_undone():
    found, rgb = made(0.1), torch.rand(300, 3, generator=torch.Generator().manual_seed(1))
    light, there = rgb / 10, place(COUNT, rgb)
    assert torch.equal(made(0.0)(light, there), light)
    changed = found(light, there)
    assert (changed - light).abs().max() > 0.01
    torch.testing.assert_close(found.undone(changed, there), light, atol=1e-5, rtol=1e-4)


def test_the_pictures_mean_is_one_whatever_is_learned():
    """The logarithms of gains add up to 0."""
    assert float(made(2.0).log_gains().sum()) == pytest.approx(0, abs=1e-5)


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
