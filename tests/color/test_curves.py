"""Curves that are fitted to a scene: what they find, and that everything comes back."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.color.auto import Auto
from ctm_plugin.color.curves import Ranged, solve
from ctm_plugin.color.transform import Chain, fitted
from ctm_plugin.errors import CTMError
from ctm_plugin.settings.registry import COLOR_SPACES

KINDS = ["gain", "log"]


def space(name: str) -> Ranged:
    return COLOR_SPACES.get(name)()


def scene(top: float, power: float = 1.0, seed: int = 0) -> torch.Tensor:
    """Colours from black to ``top``, their median at ``top / 2^power``."""
    generator = torch.Generator().manual_seed(seed)
    return top * torch.rand(4000, 3, generator=generator) ** power


def colors() -> torch.Tensor:
    """Greys: evenly, the 8-bit ones, close to black, close to white."""
    near = torch.logspace(-12, 0, 400)
    return torch.cat([torch.linspace(0, 1, 5001), torch.arange(256) / 255, near, 1 - near])[:, None].expand(-1, 3)


def oracle(name: str, color: np.ndarray, level: float, a: float) -> np.ndarray:
    part = color / level
    return 0.9 * (part if name == "gain" else np.log1p(a * part) / np.log1p(a))


@pytest.mark.parametrize("name", KINDS)
@given(top=st.sampled_from([0.002, 0.01, 0.1, 0.5, 0.95, 1.0]), power=st.sampled_from([0.1, 1.0, 5.0]))
def test_all_colours_come_back_in_their_order(name, top, power):
    fit = space(name)
    fit.begin(scene(top, power))
    latent = fit.encode(colors())
    assert latent.dtype == torch.float32
    assert latent.min() == 0
    assert fit.encode(fit.level.expand(1, 3)).max() == pytest.approx(0.9, abs=1e-6)
    torch.testing.assert_close(fit.decode(latent), colors(), atol=1e-6, rtol=0)
    order = colors()[:, 0].sort().values
    assert (fit.encode(order[:, None].expand(-1, 3)).diff(dim=0) >= 0).all()
    steps = torch.linspace(0, 1, 1001)[:, None].expand(-1, 3)
    assert (fit.encode(steps).diff(dim=0) > 0).all()
    levels = 0.9 * steps
    torch.testing.assert_close(fit.encode(fit.decode(levels)), levels, atol=2e-4, rtol=0)


@pytest.mark.parametrize("name", KINDS)
def test_black_stays_and_no_latent_is_beyond_a_colour(name):
    fit = space(name)
    fit.begin(scene(0.03, 2.0))
    black, white = torch.zeros(1, 3), torch.ones(1, 3)
    assert torch.equal(fit.encode(black), black)
    assert torch.equal(fit.decode(torch.tensor([[-1e-6, -0.5, -30.0]])), black)
    assert torch.equal(fit.decode(2 * fit.encode(white)), white)


@pytest.mark.parametrize("name", KINDS)
@given(st.sampled_from([0.01, 0.2, 1.0]))
def test_they_agree_with_numpy(name, top):
    fit = space(name)
    fit.begin(scene(top, 2.0))
    a = float(fit.a) if name == "log" else 1.0
    expected = oracle(name, colors().double().numpy(), float(fit.level), a)
    np.testing.assert_allclose(fit.encode(colors().double()), expected, atol=1e-9)


def test_the_level_is_a_high_percentile_of_the_largest_channel():
    ramp = torch.arange(1, 10001) / 10000
    rgb = 0.2 * torch.stack([ramp, 0.5 * ramp, 0 * ramp], -1)
    fit = space("gain")
    fit.begin(torch.cat([torch.zeros(90000, 3), rgb]))  # a black background does not count
    assert float(fit.level) == pytest.approx(0.2 * 0.999, abs=1e-4)
    assert fit.encode(rgb).quantile(0.999) <= 0.9
    torch.testing.assert_close(fit.encode(rgb[:500]), rgb[:500] * 0.9 / fit.level)
    assert fit.describe() == "gain 4.5"


@pytest.mark.parametrize(("rgb", "level"), [(scene(1.0), 0.9), (torch.full((10, 3), 1e-5), 1e-3)])
def test_the_level_has_a_largest_and_a_least_value(rgb, level):
    """Bright scenes stay as they are."""
    fit = space("gain")
    fit.begin(rgb)
    assert float(fit.level) == pytest.approx(level)
    torch.testing.assert_close(fit.encode(colors()), colors() * 0.9 / level, atol=1e-7, rtol=1e-6)


@given(st.floats(0.01, 0.9), st.floats(1.1, 1.8))
def test_the_median_goes_to_the_middle_of_the_range(top, power):
    rgb = scene(top, power)
    fit = space("log")
    fit.begin(torch.cat([torch.zeros(5000, 3), rgb]))
    assert fit.bounds[0] < float(fit.a) < fit.bounds[1]
    assert float(fit.encode(rgb).median()) == pytest.approx(0.45, abs=1e-4)


def test_a_bend_stays_in_its_bounds():
    fit = space("log")
    fit.begin(scene(0.5, 0.1))  # most colours are bright: as good as straight
    assert float(fit.a) == pytest.approx(fit.bounds[0])
    straight = torch.linspace(0, float(fit.level), 100)[:, None].expand(-1, 3)
    torch.testing.assert_close(fit.encode(straight), 0.9 * straight / fit.level, atol=2e-4, rtol=0)
    fit.begin(torch.cat([torch.full((1000, 3), 1e-7), torch.full((10, 3), 0.9)]))
    assert float(fit.a) == pytest.approx(fit.bounds[1])


@pytest.mark.parametrize("name", KINDS)
def test_gradients_are_finite_and_those_of_the_inverse_invert(name):
    fit = space(name)
    fit.begin(scene(0.02, 2.0))
    level = fit.level[None].double()
    color = torch.cat([torch.tensor([0.0, 1e-12, 1e-4, 0.5, 0.99]).double(), level, level * 0.5, level * 1.5])
    color = color[:, None].repeat(1, 3).requires_grad_()
    latent = fit.encode(color)
    (forth,) = torch.autograd.grad(latent.sum(), color)
    latent = latent.detach().requires_grad_()
    (back,) = torch.autograd.grad(fit.decode(latent).sum(), latent)
    assert forth.isfinite().all()
    assert (forth > 0).all()
    inside = color > 0  # at the bound itself torch >= 2.14 gives a clamp no slope
    torch.testing.assert_close((forth * back)[inside], torch.ones_like(back)[inside], atol=1e-3, rtol=0)
    assert back.isfinite().all()
    assert forth.max() < 1e5


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_taken_and_left(name, dtype):
    fit = space(name)
    fit.begin(scene(0.02).to(dtype))
    half = scene(0.02, seed=1).to(dtype)
    assert torch.equal(fit.encode(half), fit.encode(half.float()))
    torch.testing.assert_close(fit.decode(fit.encode(half)), half.float(), atol=1e-6, rtol=0)


@pytest.mark.parametrize("name", KINDS)
def test_one_colour_alone_is_fitted(name):
    rgb = torch.tensor([[0.02, 0.02, 0.0]]).expand(100, -1)
    fit = space(name)
    latent = fitted(fit, rgb)
    assert (latent[:, 2] == 0).all()
    torch.testing.assert_close(latent[:, :2], torch.full((100, 2), 0.9))
    torch.testing.assert_close(fit.decode(latent), rgb)


@pytest.mark.parametrize(
    ("rgb", "found"),
    [
        (torch.zeros(10, 3), "all black, expected some"),
        *((torch.tensor([[0.1, 0.1, bad]]), "NaN or infinity, expected") for bad in (torch.nan, torch.inf)),
    ],
)
@pytest.mark.parametrize("kind", [*KINDS, "ctm=auto"])
def test_what_cannot_be_fitted_is_told(kind, rgb, found):
    fit = Auto() if kind == "ctm=auto" else space(kind)
    fit.label = kind
    with pytest.raises(CTMError, match=f"{kind}: found training colours .*{found}"):
        fit.begin(rgb)


@pytest.mark.parametrize("name", KINDS)
def test_a_fit_is_in_the_state(name):
    fit, other = space(name), space(name)
    fit.begin(scene(0.03, 2.0))
    other.load_state_dict(fit.state_dict())
    assert torch.equal(other.encode(colors()), fit.encode(colors()))
    assert not torch.equal(space(name).encode(colors()), fit.encode(colors()))


def test_what_was_fitted_is_told_also_under_another_transform():
    fit = space("log")
    assert Chain(fit, space("gain")).describe() == fit.describe()
    fit.level.fill_(0.1)
    fit.a.fill_(250)
    assert fit.describe() == "gain 9, bent by 250"
    assert COLOR_SPACES.get("lab")().describe() is None


def test_solve_finds_a_number_or_the_nearest_bound():
    assert solve(lambda a: a**2, 9.0, 1e-3, 1e3) == pytest.approx(3, rel=1e-12)
    assert solve(lambda a: a, 5.0, 1.0, 4.0) == pytest.approx(4)
    assert solve(lambda a: a, 0.5, 1.0, 4.0) == pytest.approx(1)
