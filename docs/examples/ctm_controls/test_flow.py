"""The learned, invertible transform: its inverse, its determinant, who learns from what."""

import math

import numpy as np
import pytest
import torch
from ctm_controls.flow import Flow, FlowConfig
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.color.photometric import Photometric
from ctm_plugin.color.transform import Chain, fitted
from ctm_plugin.settings.registry import COLOR_SPACES

AXIS = torch.linspace(0, 1, 11)
CUBE = torch.cartesian_prod(AXIS, AXIS, AXIS)


def scene(top: float = 0.1, seed: int = 0) -> torch.Tensor:
    return top * torch.rand(2000, 3, generator=torch.Generator().manual_seed(seed))


def learned(size: float = 0.3, seed: int = 0, top: float = 0.1, **settings) -> Flow:
    """Fitted, its parameters moved away from where they begin."""
    flow, generator = Flow(FlowConfig(**settings)), torch.Generator().manual_seed(seed)
    flow.begin(scene(top))
    with torch.no_grad():
        for values in flow.parameters():
            values += size * torch.randn(values.shape, generator=generator)
    return flow


def no_draws(rows: int, channels: int) -> torch.Tensor:
    raise AssertionError("an invertible transform has no cycle to draw for")


def terms_of(flow: Flow, latents: list[torch.Tensor], rgb: torch.Tensor, **settings) -> dict[str, torch.Tensor]:
    return flow.losses(latents, rgb, Photometric(**settings), no_draws).terms


@given(st.floats(0, 0.5), st.integers(0, 999), st.sampled_from([0.004, 0.1, 1.0]), st.sampled_from([1, 16]))
def test_the_inverse_is_exact_and_black_stays(size, seed, top, bins):
    flow = learned(size, seed, top, bins=bins)
    for colors in (CUBE.double(), 0.01 * CUBE.double(), scene(top).double()):
        torch.testing.assert_close(flow.decode(flow.encode(colors)), colors, atol=1e-10, rtol=0)
    # Float32 latents: the scene's own colours, up to the level, are not flattened by the gain.
    inside = scene(top).clamp(max=float(flow.gain.level))
    torch.testing.assert_close(flow.decode(flow.encode(inside)), inside, atol=5e-6, rtol=0)
    black = torch.zeros(1, 3)
    assert torch.equal(flow.encode(black), black)
    assert torch.equal(flow.decode(black), black)


def test_latents_that_are_no_colour_are_clipped():
    decoded = learned(0.3, 0).decode(30 * CUBE - 10)
    assert (decoded.min(), decoded.max()) == (0, 1)


def test_all_channels_are_mixed():
    flow = learned()
    (slopes,) = torch.autograd.grad(flow.encode(CUBE).square().sum(), flow.mix)
    assert slopes.abs().min() > 1e-3


def test_it_begins_as_a_gain():
    flow, gain = Flow(), COLOR_SPACES.get("gain")()
    flow.begin(scene())
    gain.begin(scene())
    torch.testing.assert_close(flow.encode(CUBE), gain.encode(CUBE))
    assert flow.describe() == gain.describe()


@given(st.integers(0, 999))
def test_the_determinant_is_that_of_autograd_s_jacobian(seed):
    flow = learned(seed=seed)
    colors = torch.cat([scene(seed=seed)[:3], CUBE[500:502] + 0.01]).double()
    log_det = flow._forward(colors)[1].detach()
    for color, found in zip(colors, log_det, strict=True):
        jacobian = torch.autograd.functional.jacobian(flow.encode, color)
        assert float(found) == pytest.approx(float(torch.linalg.slogdet(jacobian)[1]), abs=1e-9)


def test_the_terms_are_those_of_their_formulas():
    flow, rgb = learned(), scene()[:40]
    latents = [torch.rand(40, 3), torch.rand(40, 3)]
    terms = {name: term.detach() for name, term in terms_of(flow, latents, rgb, weight=2.0).items()}
    target, log_det = (each.detach().numpy() for each in flow._forward(rgb.double()))
    sigma = np.exp(flow.log_sigma.detach().double().numpy())
    error = (latents[1].double().numpy() - target) ** 2
    nll = (error / (2 * sigma**2) + np.log(sigma)).sum(-1) - log_det
    assert float(terms["nll"]) == pytest.approx(nll.mean(), rel=1e-5)
    weight = (1 / (2 * sigma**2)).mean()
    assert 1 < weight < 100
    field = sum(((latent.double().numpy() - target) ** 2).mean() for latent in latents)
    assert float(terms["color"]) == pytest.approx(2 * weight * field, rel=1e-5)


@pytest.mark.parametrize(("sigma", "weight"), [(10.0, 1.0), (0.1, 50.0), (1e-5, 100.0)])
def test_the_field_s_weight_is_bounded(sigma, weight):
    flow, rgb = learned(), scene()[:20]
    with torch.no_grad():
        flow.log_sigma.fill_(math.log(sigma))
    terms = terms_of(flow, [torch.ones(20, 3)], rgb)
    expected = weight * (1 - flow.encode(rgb)).square().mean()
    torch.testing.assert_close(terms["color"], expected)
    assert all(term.isfinite() for term in terms.values())


def test_the_field_learns_from_one_term_and_the_transform_from_the_other():
    flow, rgb = learned(), scene()[:40]
    latents = [torch.rand(40, 3, requires_grad=True) for _ in range(2)]
    terms = terms_of(flow, latents, rgb)
    field, own = latents, list(flow.parameters())
    assert all(torch.autograd.grad(terms["color"], value, retain_graph=True)[0].abs().sum() > 0 for value in field)
    of_own = torch.autograd.grad(terms["color"], own, allow_unused=True, retain_graph=True)
    assert of_own == (None, None, None)
    assert all(torch.autograd.grad(terms["nll"], value, retain_graph=True)[0].abs().sum() > 0 for value in own)
    assert torch.autograd.grad(terms["nll"], field, allow_unused=True) == (None, None)


def test_gradients_are_finite_at_black_and_white():
    flow = learned()
    terms = terms_of(flow, [torch.rand(2, 3)], torch.tensor([[0.0] * 3, [1.0] * 3]))
    assert all(each.isfinite().all() for each in torch.autograd.grad(terms["nll"], list(flow.parameters())))


def test_it_does_not_shrink_colours_to_a_point_and_finds_the_noise():
    """Renderings are the colours' own encoding at the start, off by known noise: that is its likelihood's sigma."""
    flow, rgb = Flow(), scene(1.0)
    flow.begin(rgb)
    noise = 0.05 * torch.randn(2000, 3, generator=torch.Generator().manual_seed(1))
    latent = flow.encode(rgb).detach() + noise
    adam = torch.optim.Adam(flow.parameters(), 0.02)
    for _ in range(300):
        adam.zero_grad()
        terms_of(flow, [latent], rgb)["nll"].backward()
        adam.step()
    torch.testing.assert_close(flow.log_sigma.exp(), torch.full((3,), 0.05), atol=0.01, rtol=0)
    assert flow.encode(rgb).std(0).min() > 0.8 * latent.std(0).min()


def test_under_a_fitted_space_black_stays_and_all_comes_back():
    outer, flow = COLOR_SPACES.get("log")(), Flow()
    chain, rgb = Chain(outer, flow), scene(0.05)
    latent = fitted(chain, rgb)
    torch.testing.assert_close(chain.decode(latent), rgb, atol=1e-5, rtol=0)
    assert torch.equal(chain.decode(torch.zeros(1, 3)), torch.zeros(1, 3))
    assert chain.describe() == outer.describe()
