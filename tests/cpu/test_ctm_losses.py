"""CTM's losses in one pass against torch's, which GPUs run; tests/color hold both to the paper's formulas."""

import math

import pytest
import torch
from hypothesis import given as examples
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional as F

from ctm_plugin.color.ctm import CTM, Given, SinusoidalMLP, five_terms
from ctm_plugin.color.photometric import Photometric
from ctm_plugin.color.settings import CTMConfig, LossWeights
from ctm_plugin.cpu import ctm_losses as loops
from ctm_plugin.cpu.ctm_losses import GROUPS
from ctm_plugin.cpu.ctm_networks import TILE
from ctm_plugin.rays.encoding import embed

WEIGHTS = {"enc": 1.0, "dec": 2.0, "img": 3.0, "rand": 4.0, "latent": 5.0}


def margin(ctm: CTM) -> float:
    """More than rounding adds up to: an angle's own doubles from frequency to frequency."""
    return 2e-6 * 2**ctm.config.P


def through(ctm: CTM, colors: Tensor, network: SinusoidalMLP) -> tuple[Tensor, Tensor]:
    """What a network makes of colours, and for which of them no hidden unit is within rounding of its ReLU's kink.

    On which side of it rounding puts a unit, the gradients see.
    """
    *hidden, last = network.linear
    far = torch.ones(len(colors), dtype=torch.bool)
    values = embed(colors.double(), network.frequencies.double())
    for linear in hidden:
        values = F.linear(values, linear.weight.double(), linear.bias.double())
        far &= (values.abs() > margin(ctm)).all(1)
        values = values.relu()
    return F.linear(values, last.weight.double(), last.bias.double()).sigmoid(), far


@torch.no_grad()
def draw(ctm: CTM, rays: int, renderings: int, drawn: int) -> tuple[list[Tensor], Tensor, Tensor, Tensor]:
    """Latents, training colours, random colours, random latents: none at a kink, of absolute differences included."""
    rng = torch.Generator().manual_seed(rays)

    def cycle(channels: int, count: int, first: SinusoidalMLP, second: SinusoidalMLP) -> tuple[Tensor, Tensor, Tensor]:
        colors = torch.rand(2 * count + 20, channels, generator=rng)
        between, far = through(ctm, colors, first)
        return colors, between, far & through(ctm, between, second)[1]

    rgb, encoded, far = cycle(3, rays, ctm.encoder, ctm.decoder)
    latents = [torch.rand(len(rgb), ctm.channels, generator=rng) for _ in range(renderings)]
    for latent in latents:
        decoded, far_too = through(ctm, latent, ctm.decoder)
        differences = torch.cat([latent - encoded, decoded - rgb], dim=1)
        far &= far_too & (differences.abs() > margin(ctm)).all(1)
    random, _, random_far = cycle(3, drawn, ctm.encoder, ctm.decoder)
    random_latent, _, latent_far = cycle(ctm.channels, drawn, ctm.decoder, ctm.encoder)
    given = rgb[far][:rays], random[random_far][:drawn], random_latent[latent_far][:drawn]
    assert [*map(len, given)] == [rays, drawn, drawn]
    return [latent[far][:rays] for latent in latents], *given


def both_ways(
    ctm: CTM, rays: int, renderings: int = 1, kind: str = "mse", upstream: tuple = (1.0,) * 5, drawn: int = 9
) -> list[tuple[list[Tensor], list[Tensor]]]:
    """Terms and target, and all gradients, by the loops and by torch."""
    rendered, *colors = draw(ctm, rays, renderings, drawn)
    networks, how, found = (ctm.encoder, ctm.decoder), (ctm.config.weights, ctm.config.reduction), []
    for run in (five_terms, five_terms.reference):
        latents = [latent.clone().requires_grad_() for latent in rendered]
        ctm.zero_grad()
        terms, target = run(*networks, Given(latents, *colors), Photometric(kind=kind, weight=0.7), *how)
        sum(factor * term for factor, term in zip(upstream, terms.values(), strict=False)).backward()
        gradients = [each.grad for each in (*latents, *ctm.parameters())]
        found.append(([*terms.values(), target], [each for each in gradients if each is not None]))
        assert not target.requires_grad
    return found


def close(ours: tuple, theirs: tuple, values: float = 5e-6, gradients: float = 5e-6) -> None:
    """Of a sum whose terms cancel, such as a gradient far below the others, rounding leaves more."""
    for tolerance, *pair in zip((values, gradients), ours, theirs, strict=True):
        largest = max(other.norm() for other in pair[1])
        for one, other in zip(*pair, strict=True):
            assert (one - other).norm() <= tolerance * (other.norm() + 0.01 * largest)


@examples(
    st.integers(1, 3 * TILE),
    st.fixed_dictionaries(
        {
            "k": st.integers(1, 5), "P": st.integers(0, 6), "width": st.sampled_from([1, 2, 7, 30, 64]),
            "depth": st.integers(1, 3), "frequency": st.sampled_from(["pi", "unit"]),
            "reduction": st.sampled_from(["sum", "mean"]),
        }
    ),
    st.integers(1, 2),
    st.sampled_from(["mse", "l1"]),
)  # fmt: skip
def test_torch_alone(rays, settings, renderings, kind):
    torch.manual_seed(rays)
    ctm = CTM(CTMConfig(weights=LossWeights(**WEIGHTS), **settings))
    for linear in (*ctm.encoder.linear, *ctm.decoder.linear):  # where all units before are off, one is what its bias is
        linear.bias.data += 0.01 * linear.bias.sign()
    # Angles' rounding doubles from frequency to frequency.
    found = both_ways(ctm, rays, renderings, kind)
    close(*found, values=4e-6 * 2 ** settings["P"], gradients=2e-5 * 2 ** settings["P"])


@pytest.mark.parametrize("upstream", [(0.3,) * 5, (0.0,) * 5, (-2.0,) * 5, (1.0, 0.0, 3.0, -1.0, 0.5)], ids=str)
def test_gradients_from_above(upstream):
    close(*both_ways(CTM(CTMConfig(weights=LossWeights(**WEIGHTS))), 70, 2, upstream=upstream))


@pytest.mark.parametrize("dropped", WEIGHTS)
def test_terms_of_no_weight(dropped):
    weights = LossWeights(**WEIGHTS | {dropped: 0.0})
    close(*both_ways(CTM(CTMConfig(weights=weights)), 70, 2))


def test_terms_of_no_weight_do_not_cost_a_second_pass(monkeypatch):
    passes = []
    run = loops._with_gradients
    monkeypatch.setattr(loops, "_with_gradients", lambda *args: passes.append(1) or run(*args))
    ctm = CTM(CTMConfig(weights=LossWeights(rand=0.0, latent=0.0)))
    for terms, expected in ((("enc", "dec", "img"), 1), (("enc",), 2)):
        passes.clear()
        found = ctm.losses([torch.rand(9, 3, requires_grad=True)], torch.rand(9, 3), Photometric(), torch.rand).terms
        sum(found[name] for name in terms).backward()
        assert len(passes) == expected


def test_three_passes_backward():
    """Gradients of the first are the loops' own memory, to which the second adds."""
    ctm, latent = CTM(), torch.rand(9, 3, requires_grad=True)
    loss = sum(ctm.losses([latent], torch.rand(9, 3), Photometric(), torch.rand).terms.values())
    once = torch.autograd.grad(loss, [latent, *ctm.parameters()], retain_graph=True)
    for _ in range(3):
        loss.backward(retain_graph=True)
    for parameter, gradient in zip([latent, *ctm.parameters()], once, strict=True):
        torch.testing.assert_close(parameter.grad, 3 * gradient)
    first = CTM().losses([latent], torch.rand(9, 3), Photometric(), torch.rand).terms["dec"]
    first.backward()
    with pytest.raises(RuntimeError, match="a second time"):
        first.backward()


def test_without_a_field():
    close(*both_ways(CTM(CTMConfig(weights=LossWeights(**WEIGHTS))), 300, 0))


def test_other_numbers_of_random_colors():
    ctm = CTM(CTMConfig(weights=LossWeights(**WEIGHTS)))
    for rays, drawn in ((1, 2 * TILE + 1), (TILE + 1, 1)):
        close(*both_ways(ctm, rays, drawn=drawn))


def test_more_tiles_than_sums():
    close(*both_ways(CTM(), (GROUPS + 3) * TILE + 5, drawn=1000), values=1e-6, gradients=1e-5)


def test_the_number_of_threads_does_not_matter():
    """To the bit: the same machine code goes through the same tiles, whose sums are added up in a fixed order."""
    ctm, before, found = CTM(), torch.get_num_threads(), []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        try:
            values, gradients = both_ways(ctm, 5 * TILE)[0]
            found.append([*values, *gradients])
        finally:
            torch.set_num_threads(before)
    assert all(torch.equal(one, other) for each in found[1:] for one, other in zip(found[0], each, strict=True))


@pytest.mark.parametrize("value", [math.nan, math.inf, -3.0, 40.0])
def test_renderings_out_of_range(value):
    """What is not a number reaches the losses, as torch's own would, and large angles keep their sines."""
    ctm, rgb = CTM(), torch.rand(20, 3)
    latent = torch.rand(20, 3)
    latent[3, 1] = value
    given = Given([latent], rgb, torch.rand(2, 3), torch.rand(2, 3))
    arguments = ctm.encoder, ctm.decoder, given, Photometric(), ctm.config.weights, "sum"
    ours, theirs = (run(*arguments) for run in (five_terms, five_terms.reference))
    for name, term in ours[0].items():
        torch.testing.assert_close(term, theirs[0][name], rtol=1e-4, atol=0, equal_nan=True)
    torch.testing.assert_close(ours[1], theirs[1])


def test_it_is_what_a_cpu_runs_in_float32(monkeypatch):
    ctm, ran = CTM(), []
    monkeypatch.setattr(loops, "_with_gradients", lambda *args, run=loops._with_gradients: ran.append(1) or run(*args))
    for rows, dtype in ((4, torch.float32), (0, torch.float32), (4, torch.float64)):
        ctm.losses([], torch.rand(rows, 3, dtype=dtype), Photometric(), torch.rand)
    assert len(ran) == 1


def test_second_derivatives_are_refused():
    latent = torch.rand(4, 3, requires_grad=True)
    terms, _ = CTM().losses([latent], torch.rand(4, 3), Photometric(), torch.rand)
    (gradient,) = torch.autograd.grad(terms["dec"].square(), latent, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()
