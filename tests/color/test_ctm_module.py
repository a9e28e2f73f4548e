"""The module and its losses against the paper's equations, written out in float64."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.color.ctm import CTM, SinusoidalMLP
from ctm_plugin.color.photometric import Photometric
from ctm_plugin.color.settings import CTMConfig, LossWeights
from ctm_plugin.errors import ConfigError
from ctm_plugin.settings.build import build

RAYS, RANDOM = 11, 17
TERMS = ("enc", "dec", "img", "rand", "latent")
CYCLES = TERMS[2:]
# Weights that tell the terms apart and are alike in size.
WEIGHTS = LossWeights(enc=1.5, dec=2.0, img=3.0, rand=5.0, latent=7.0)


def rand(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


class Source:
    """Uniform numbers that are remembered: ``drawn[0]`` the random colours, ``drawn[1]`` the random latents."""

    def __init__(self):
        self.drawn = []

    def __call__(self, rows: int, channels: int) -> torch.Tensor:
        self.drawn.append(rand(rows, channels, seed=100 + len(self.drawn)))
        return self.drawn[-1]


def build_ctm(seed: int = 0, **settings) -> CTM:
    torch.manual_seed(seed)
    ctm = CTM(CTMConfig(**{"weights": WEIGHTS} | settings))
    with torch.no_grad():
        # Away from the sigmoid's middle, where all colours would look alike.
        for parameter in ctm.parameters():
            parameter.mul_(2.0)
    return ctm


def gamma(color: torch.Tensor, config: CTMConfig) -> torch.Tensor:
    """Eq. 7."""
    scale = math.pi if config.frequency == "pi" else 1.0
    return torch.cat(
        [color]
        + [torch.sin(scale * 2**p * color) for p in range(config.P)]
        + [torch.cos(scale * 2**p * color) for p in range(config.P)],
        dim=1,
    )


def perceptron(color: torch.Tensor, parameters: list[torch.Tensor], config: CTMConfig) -> torch.Tensor:
    """Linear layers with ReLU between them and a sigmoid at the end."""
    hidden = gamma(color, config)
    layers = list(zip(parameters[::2], parameters[1::2], strict=True))
    for index, (matrix, bias) in enumerate(layers):
        hidden = hidden @ matrix.T + bias
        if index < len(layers) - 1:
            hidden = hidden * (hidden > 0)
    return 1 / (1 + torch.exp(-hidden))


class Paper:
    """Section 3 in float64, from a CTM's parameters."""

    def __init__(self, ctm: CTM):
        self.config = ctm.config
        self.encoder, self.decoder = (
            [p.detach().double().requires_grad_() for p in net.parameters()] for net in (ctm.encoder, ctm.decoder)
        )

    def f(self, color: torch.Tensor) -> torch.Tensor:
        return perceptron(color, self.encoder, self.config)

    def g(self, latent: torch.Tensor) -> torch.Tensor:
        return perceptron(latent, self.decoder, self.config)

    def losses(self, latents, rgb, random_rgb, random_latent, kind="mse", factor=1.0) -> dict[str, torch.Tensor]:
        """Eq. 4, 5, 8 and 9, unweighted but for ``factor`` on the photometric ones."""

        def norm(error, power):
            rows = error.abs().pow(power).sum(dim=1)
            return sum(rows) / len(rows) / (1 if self.config.reduction == "sum" else error.shape[1])

        power = {"mse": 2, "l1": 1}[kind]
        return {
            "enc": factor * sum(norm(latent - self.f(rgb), power) for latent in latents),
            "dec": factor * sum(norm(self.g(latent) - rgb, power) for latent in latents),
            "img": norm(rgb - self.g(self.f(rgb)), 2),
            "rand": norm(random_rgb - self.g(self.f(random_rgb)), 2),
            "latent": norm(random_latent - self.f(self.g(random_latent)), 2),
        }


@pytest.mark.parametrize("k", range(1, 6))
@pytest.mark.parametrize("shape", [(), (0,), (7,), (2, 5)], ids=str)
def test_shapes(k, shape):
    ctm = CTM(CTMConfig(k=k))
    latent = ctm.encode(torch.rand(*shape, 3))
    assert ctm.channels == k
    assert latent.shape == (*shape, k)
    assert ctm.decode(latent).shape == (*shape, 3)


@pytest.mark.parametrize(
    ("settings", "layers"),
    [
        ({}, [(27, 64), (64, 3)]),
        ({"P": 0}, [(3, 64), (64, 3)]),
        ({"width": 7, "depth": 3}, [(27, 7), (7, 7), (7, 7), (7, 3)]),
    ],
    ids=["paper", "no_frequencies", "deep"],
)
def test_layers(settings, layers):
    ctm = CTM(CTMConfig(**settings))
    for net in (ctm.encoder, ctm.decoder):
        linear = [layer for layer in net.layers if isinstance(layer, torch.nn.Linear)]
        assert [(layer.in_features, layer.out_features) for layer in linear] == layers
    assert set(ctm.state_dict()) == {name for name, _ in ctm.named_parameters()}


@given(st.integers(0, 1000), st.sampled_from([1e-2, 1.0, 100.0]))
def test_ranges(seed, scale):
    ctm = build_ctm(seed)
    with torch.no_grad():
        for parameter in ctm.parameters():
            parameter.mul_(scale)
    for values in (ctm.encode(rand(50, 3, seed=seed)), ctm.decode(rand(50, 3, seed=seed))):
        assert ((values >= 0) & (values <= 1)).all()


@pytest.mark.parametrize("settings", [{}, {"P": 0}, {"frequency": "unit"}, {"k": 5, "depth": 2, "width": 16}], ids=str)
def test_encoder_and_decoder(settings):
    ctm = build_ctm(**settings)
    paper = Paper(ctm)
    rgb, latent = rand(20, 3), rand(20, ctm.channels)
    for ours, theirs in [(ctm.encode(rgb), paper.f(rgb.double())), (ctm.decode(latent), paper.g(latent.double()))]:
        torch.testing.assert_close(ours, theirs.float(), atol=5e-6, rtol=0)
        assert ours.std(0).min() > 0.01


@pytest.mark.parametrize("reduction", ["sum", "mean"])
@pytest.mark.parametrize("kind", ["mse", "l1"])
@pytest.mark.parametrize("renderings", [1, 2])
@pytest.mark.parametrize("k", [1, 3, 5])
def test_five_terms(reduction, kind, renderings, k):
    ctm = build_ctm(k=k, reduction=reduction, random_colors=RANDOM)
    rgb = rand(RAYS, 3)
    latents = [rand(RAYS, k, seed=seed).requires_grad_() for seed in range(1, 1 + renderings)]
    source = Source()
    terms, target = ctm.losses(latents, rgb, Photometric(kind=kind, weight=0.5), source)

    assert [tuple(drawn.shape) for drawn in source.drawn] == [(RANDOM, 3), (RANDOM, k)]
    paper = Paper(ctm)
    rendered = [latent.detach().double().requires_grad_() for latent in latents]
    exact = paper.losses(rendered, rgb.double(), *(drawn.double() for drawn in source.drawn), kind, 0.5)
    assert list(terms) == list(TERMS)
    torch.testing.assert_close(target, paper.f(rgb.double()).detach().float(), atol=1e-5, rtol=0)

    ours = [*latents, *ctm.encoder.parameters(), *ctm.decoder.parameters()]
    theirs = [*rendered, *paper.encoder, *paper.decoder]
    for name, term in terms.items():
        expected = getattr(WEIGHTS, name) * exact[name]
        torch.testing.assert_close(term.double(), expected, rtol=2e-5, atol=1e-7)
        got, wanted = (
            torch.autograd.grad(t, p, retain_graph=True, materialize_grads=True)
            for t, p in ((term, ours), (expected, theirs))
        )
        for a, b in zip(got, wanted, strict=True):
            torch.testing.assert_close(a.double(), b, rtol=1e-3, atol=1e-5)


def test_as_many_random_colors_as_rays():
    source = Source()
    build_ctm().losses([rand(RAYS, 3)], rand(RAYS, 3), Photometric(), source)
    assert [len(drawn) for drawn in source.drawn] == [RAYS, RAYS]


@pytest.mark.parametrize("dropped", TERMS)
def test_weight_zero_drops_a_term(dropped):
    ctm = build_ctm()
    rgb, latents = rand(RAYS, 3), [rand(RAYS, 3, seed=1), rand(RAYS, 3, seed=2)]
    every, target = ctm.losses(latents, rgb, Photometric(), Source())
    ctm.config = CTMConfig(weights=LossWeights(**vars(WEIGHTS) | {dropped: 0.0}))
    draws = [call for call, name in (((RAYS, 3), "rand"), ((RAYS, 3), "latent")) if name != dropped]
    source = Source()
    terms, same = ctm.losses(latents, rgb, Photometric(), source)
    assert [tuple(drawn.shape) for drawn in source.drawn] == draws
    assert list(terms) == [name for name in TERMS if name != dropped]
    torch.testing.assert_close(same, target)
    for name, term in terms.items():
        if not (dropped == "rand" and name == "latent"):  # other random numbers
            torch.testing.assert_close(term, every[name])


def test_cycle_loss():
    ctm, rgb, source = build_ctm(random_colors=RANDOM), rand(RAYS, 3), Source()
    loss = ctm.cycle_loss(rgb, source)
    exact = Paper(ctm).losses([], rgb.double(), *(drawn.double() for drawn in source.drawn))
    expected = sum(getattr(WEIGHTS, name) * exact[name] for name in CYCLES)
    torch.testing.assert_close(loss.double(), expected, rtol=2e-5, atol=0)
    loss.backward()
    assert all(parameter.grad.abs().sum() > 0 for parameter in ctm.parameters())


def dark_colors(count: int = 4000) -> torch.Tensor:
    return rand(count, 3) * torch.tensor([0.08, 0.1, 0.05]) + 0.01


@pytest.mark.parametrize("k", [1, 2, 3, 5])
@pytest.mark.parametrize("depth", [1, 3])
@pytest.mark.parametrize("spread", [1.0, 0.1], ids=["dark", "narrow"])
def test_range_begins_with_affine_maps(k, depth, spread):
    """f fills the cube, g has the value and slope of its inverse in the middle, by their formulas in float64.

    The units that are not part of them are silenced.
    """
    ctm = CTM(CTMConfig(k=k, depth=depth, init="range"))
    colors, latents = 0.03 + spread * dark_colors(), rand(50, k, seed=1)
    ctm.begin(colors)
    with torch.no_grad():
        for net in (ctm.encoder, ctm.decoder):
            net.layers[-2].weight[:, 3 if net is ctm.encoder else k :] = 0
        found, back = ctm.encode(colors).numpy(), ctm.decode(latents).numpy()
    low, high = np.quantile(colors.double().numpy(), [0.01, 0.99], axis=0)
    middle, gain = (low + high) / 2, 4 / max((high - low).max(), 1 / 64)
    together = np.equal.outer(np.arange(k) % min(k, 3), np.arange(3) % min(k, 3))
    expected = gain * (colors.double().numpy() - middle) @ (together / together.sum(1, keepdims=True)).T
    np.testing.assert_allclose(found, 1 / (1 + np.exp(-expected)), atol=1e-5)
    slope = np.minimum(4 / (gain * middle * (1 - middle)), 16)
    expected = slope * (latents.double().numpy() @ (together / together.sum(0)) - 0.5)
    np.testing.assert_allclose(back, 1 / (1 + (1 - middle) / middle * np.exp(-expected)), atol=1e-5)


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_range_of_one_colour_is_finite(level):
    ctm = CTM(CTMConfig(init="range"))
    ctm.begin(torch.full((100, 3), level))
    assert all(parameter.isfinite().all() for parameter in ctm.parameters())


def test_random_begins_where_it_was_made():
    ctm, before = build_ctm(), build_ctm().state_dict()
    ctm.begin(dark_colors())
    assert all(torch.equal(value, before[name]) for name, value in ctm.state_dict().items())


def test_cycles_alone_find_the_identity():
    torch.manual_seed(0)
    ctm, rgb = CTM(CTMConfig(weights=LossWeights(img=100.0))), rand(256, 3)
    adam, generator = torch.optim.Adam(ctm.parameters(), 5e-3), torch.Generator().manual_seed(1)

    def error() -> float:
        return (ctm.decode(ctm.encode(rgb)) - rgb).square().mean().sqrt().item()

    before = error()
    for _ in range(100):
        adam.zero_grad()
        ctm.cycle_loss(rgb, lambda rows, channels: torch.rand(rows, channels, generator=generator)).backward()
        adam.step()
    assert error() < before / 3


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_all_is_float32_whatever_is_given(dtype):
    """Under autocast, and of renderings in half precision."""
    ctm, rgb, latents = build_ctm(), rand(RAYS, 3), [rand(RAYS, 3, seed=1).to(dtype)]
    plain, target = ctm.losses([latents[0].float()], rgb, Photometric(), Source())
    seen = []
    for layer in ctm.modules():
        if isinstance(layer, torch.nn.Linear):
            layer.register_forward_hook(lambda _, given, out: seen.extend((*given, out)))

    def enters(call, colors) -> torch.Tensor:
        """What the first layer is given; all layers are float32."""
        seen.clear()
        assert call(colors).dtype == torch.float32
        assert {each.dtype for each in seen} == {torch.float32}
        return seen[0]

    whole, half = enters(ctm.encode, rgb), enters(ctm.decode, latents[0].float())
    assert torch.equal(enters(ctm.encode, rgb.double()), whole)
    with torch.autocast("cpu", dtype=dtype):
        assert torch.equal(enters(ctm.encode, rgb), whole)
        assert torch.equal(enters(ctm.decode, latents[0]), half)
        terms, same = ctm.losses(latents, rgb, Photometric(), Source())
    assert torch.equal(same, target)
    for name, term in terms.items():
        assert term.dtype == torch.float32
        assert torch.equal(term, plain[name])


def test_gradients_of_layers_are_float32_under_autocast():
    """With the backward pass outside of it, where torch wants it."""
    color, weight, found = rand(2, 300, 3), rand(2, 300, 3, seed=1), []
    for enabled in (False, True):
        module, given = SinusoidalMLP(3, 3, CTMConfig(depth=2)), color.clone().requires_grad_()
        module.load_state_dict(build_ctm(depth=2).encoder.state_dict())
        with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
            loss = (module(given) * weight).sum()
        loss.backward()
        found.append([given.grad, *(parameter.grad for parameter in module.parameters())])
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))


@pytest.mark.parametrize("settings", [{"width": 4, "k": 5, "init": "range"}, {"weights": {"enc": -1e-9}}], ids=str)
def test_bad_settings(settings):
    with pytest.raises(ConfigError, match=r"^ctm\.(width|weights\.enc): found .*, expected "):
        build(CTMConfig, settings, "ctm")
