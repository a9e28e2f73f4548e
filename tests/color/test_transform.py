"""The seam: fixed spaces, transforms on top of each other, the plain loss."""

import pytest
import torch
import torch.nn.functional as F

from ctm_plugin.color.ctm import CTM
from ctm_plugin.color.photometric import Photometric
from ctm_plugin.color.settings import CTMConfig
from ctm_plugin.color.transform import Chain, ColorLoss, ColorTransform, fitted
from ctm_plugin.settings.registry import COLOR_SPACES

SPACES = {name: COLOR_SPACES.get(name)() for name in COLOR_SPACES.ours}
NAMES = list(SPACES)


def colors(rows: int = 20, channels: int = 3, seed: int = 0) -> torch.Tensor:
    return torch.rand(rows, channels, generator=torch.Generator().manual_seed(seed))


def uniform(rows: int, channels: int) -> torch.Tensor:
    return colors(rows, channels, seed=9)


def no_draws(rows: int, channels: int) -> torch.Tensor:
    raise AssertionError("a fixed transform drew random numbers")


class Affine(ColorTransform):
    """``scale * rgb + shift``: affine maps do not commute."""

    def __init__(self, scale: float, shift: float):
        super().__init__()
        self.scale, self.shift = scale, shift

    def encode(self, rgb):
        return self.scale * rgb + self.shift

    def decode(self, latent):
        return (latent - self.shift) / self.scale

    def losses(self, latents, rgb, photometric, uniform):
        return ColorLoss({"mine": rgb.sum() + photometric.weight * uniform(1, 1).sum()}, rgb)

    def cycle_loss(self, rgb, uniform):
        return rgb.sum() + uniform(1, 1).sum()


@pytest.mark.parametrize("name", NAMES)
def test_a_space_of_ours_holds_what_it_was_fitted_to_alone(name):
    space = SPACES[name]
    assert space.channels == 3
    assert not list(space.parameters())
    assert (not space.state_dict()) == (type(space).begin is ColorTransform.begin)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("kind", "plain"), [("mse", F.mse_loss), ("l1", F.l1_loss)], ids=["mse", "l1"])
def test_plain_loss(name, kind, plain):
    rgb, latent = colors(), colors(seed=1).requires_grad_()
    terms, target = SPACES[name].losses([latent], rgb, Photometric(kind=kind, weight=2.0), no_draws)
    assert list(terms) == ["color"]
    expected = 2.0 * plain(latent, SPACES[name].encode(rgb))
    torch.testing.assert_close(terms["color"], expected)
    torch.testing.assert_close(*(torch.autograd.grad(loss, latent)[0] for loss in (terms["color"], expected)))
    assert torch.equal(target, SPACES[name].encode(rgb))
    assert SPACES[name].cycle_loss(rgb, no_draws) == 0


def test_plain_loss_adds_up_over_renderings():
    rgb, latents = colors(), [colors(seed=seed) for seed in (1, 2, 3)]
    terms, _ = SPACES["rgb"].losses(latents, rgb, Photometric(), no_draws)
    torch.testing.assert_close(terms["color"], sum(F.mse_loss(latent, rgb) for latent in latents))


def test_plain_loss_takes_no_gradient_to_the_colors():
    rgb, latent = colors().requires_grad_(), colors(seed=1).requires_grad_()
    terms, _ = SPACES["lab"].losses([latent], rgb, Photometric(), no_draws)
    terms["color"].backward()
    assert rgb.grad is None
    assert latent.grad.abs().sum() > 0


def test_chain_composes():
    rgb, chain = colors(), Chain(Affine(2.0, 0.5), Affine(3.0, -1.0))
    torch.testing.assert_close(chain.encode(rgb), 3 * (2 * rgb + 0.5) - 1)
    torch.testing.assert_close(chain.decode(rgb), ((rgb + 1) / 3 - 0.5) / 2)
    torch.testing.assert_close(chain.decode(chain.encode(rgb)), rgb)


def test_chain_s_inner_transform_sees_the_outer_space():
    rgb, chain = colors(), Chain(Affine(2.0, 0.5), Affine(3.0, -1.0))
    seen = 2 * rgb + 0.5
    terms, target = chain.losses([], rgb, Photometric(weight=4.0), uniform)
    draw = uniform(1, 1).sum()
    torch.testing.assert_close(terms["mine"], seen.sum() + 4 * draw)
    torch.testing.assert_close(target, seen)
    torch.testing.assert_close(chain.cycle_loss(rgb, uniform), seen.sum() + draw)


class Centred(ColorTransform):
    """Fitted: the scene's mean goes to the middle."""

    def __init__(self):
        super().__init__()
        self.register_buffer("shift", torch.zeros(3))

    def begin(self, rgb):
        self.shift = 0.5 - rgb.mean(0)

    def encode(self, rgb):
        return rgb + self.shift

    def decode(self, latent):
        return latent - self.shift


def test_chain_s_outer_space_is_fitted_first():
    rgb, states = 0.2 * colors(200), []
    for chained in (True, False):
        torch.manual_seed(0)
        outer, ctm = Centred(), CTM(CTMConfig(init="range"))
        Chain(outer, ctm).begin(rgb) if chained else ctm.begin(rgb + 0.5 - rgb.mean(0))
        states.append(ctm.state_dict())
    assert all(torch.equal(value, states[1][name]) for name, value in states[0].items())
    latent = fitted(outer, rgb)
    torch.testing.assert_close(latent.mean(0), torch.full((3,), 0.5))
    torch.testing.assert_close(outer.state_dict()["shift"], 0.5 - rgb.mean(0))


@pytest.mark.parametrize("k", [1, 5])
def test_ctm_on_a_handcrafted_space(k):
    space, ctm = SPACES["hsv_cart"], CTM(CTMConfig(k=k))
    chain, rgb = Chain(space, ctm), colors()
    assert chain.channels == k
    assert len(list(chain.parameters())) == len(list(ctm.parameters()))
    latent = chain.encode(rgb)
    torch.testing.assert_close(latent, ctm.encode(space.encode(rgb)))
    torch.testing.assert_close(chain.decode(latent), space.decode(ctm.decode(latent)))
    latents = [colors(20, k, seed=1)]
    got, _ = chain.losses(latents, rgb, Photometric(), uniform)
    expected, _ = ctm.losses(latents, space.encode(rgb), Photometric(), uniform)
    assert got.keys() == expected.keys() == {"enc", "dec", "img", "rand", "latent"}
    for name, term in got.items():
        torch.testing.assert_close(term, expected[name])
