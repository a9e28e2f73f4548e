import colorsys

import numpy as np
import pytest
import skimage.color
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tolerance import assert_within, of_functions

from ctm_plugin.color import spaces
from ctm_plugin.settings.registry import COLOR_SPACES

SPACES = {name: COLOR_SPACES.get(name)() for name in COLOR_SPACES.ours}
for space in SPACES.values():
    space.begin(0.1 * torch.rand(4000, 3, generator=torch.Generator().manual_seed(0)))
NAMES = list(SPACES)
# The table in the module's docstring: multiply and add to get scikit-image's units.
UNITS = {"lab": ((100, 255, 255), (0, -128, -128)), "luv": ((100, 354, 262), (0, -134, -140))}


def grid(steps: int = 17) -> torch.Tensor:
    """The whole cube, its corners, greys and primaries included."""
    axis = torch.linspace(0, 1, steps)
    return torch.cartesian_prod(axis, axis, axis)


def hard_colors() -> torch.Tensor:
    """The cube, the cube in the dark, colours near grey, near black, and numbers too small for float32 to divide by."""
    generator = torch.Generator().manual_seed(0)
    grey = torch.rand(400, 1, generator=generator)
    power = torch.randint(-9, -2, (400, 1), generator=generator)
    near_grey = (grey + torch.randn(400, 3, generator=generator) * 10.0**power).clamp(0, 1)
    dark = [scale * near_grey for scale in (1e-3, 1e-6, 1e-20, 1e-38)]
    return torch.cat([grid(), 0.01 * grid(), near_grey, *dark, 1e-44 * grid()])


def hard_latents() -> torch.Tensor:
    """All of the latent cube, most of it outside the space's gamut, and the centre of the disc closely."""
    dark = grid() * torch.tensor([1e-6, 1.0, 1.0])
    return torch.cat([grid(), 0.5 + 1e-4 * (grid() - 0.5), 0.5 + 1e-8 * (grid() - 0.5), dark, 1e-44 * grid()])


def gradients(function, points: torch.Tensor) -> torch.Tensor:
    points = points.clone().requires_grad_()
    values = function(points)
    return torch.stack([torch.autograd.grad(values[:, i].sum(), points, retain_graph=True)[0] for i in range(3)])


def hue_distance(first, second) -> np.ndarray:
    return np.abs((np.asarray(first) - np.asarray(second) + 0.5) % 1.0 - 0.5)


@pytest.mark.parametrize("name", NAMES)
def test_encoded_colours_lie_in_the_unit_cube_and_come_back(name):
    space = SPACES[name]
    colors = hard_colors()
    latent = space.encode(colors)
    assert latent.isfinite().all()
    beyond = ("gain", "log")  # colours unlike the scene's are
    assert name in beyond or (latent.min() >= 0 and latent.max() <= 1)
    torch.testing.assert_close(space.decode(latent), colors, atol=2e-5, rtol=0)


@pytest.mark.parametrize("name", NAMES)
def test_every_8_bit_grey_and_every_dark_8_bit_colour_comes_back_exactly(name):
    space = SPACES[name]
    levels = torch.arange(256.0)
    dark = torch.cartesian_prod(*[torch.arange(12.0)] * 3)
    bits = torch.cat([levels[:, None].expand(-1, 3), dark])
    assert torch.equal((space.decode(space.encode(bits / 255)) * 255).round(), bits)


@pytest.mark.parametrize("name", NAMES)
def test_any_latent_decodes_into_the_unit_cube(name):
    decoded = SPACES[name].decode(hard_latents())
    assert decoded.isfinite().all()
    assert decoded.min() >= 0
    assert decoded.max() <= 1


@pytest.mark.parametrize("name", ["gain", "log"])
def test_without_a_scene_curves_are_straight(name):
    colors = grid()
    torch.testing.assert_close(COLOR_SPACES.get(name)().encode(colors), colors, atol=2e-4, rtol=0)


def test_rgb_alone_clips():
    assert SPACES["rgb"].decode(torch.tensor([-1.0, 0.3, 3.0])).tolist() == pytest.approx([0.0, 0.3, 1.0])


@pytest.mark.parametrize("name", NAMES)
def test_gradients_are_finite_everywhere(name):
    space = SPACES[name]
    encoded, decoded = gradients(space.encode, hard_colors()), gradients(space.decode, hard_latents())
    assert encoded.isfinite().all()
    assert decoded.isfinite().all()
    assert encoded.abs().max() < 1e7
    assert decoded.abs().max() < 100


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=20)  # of the same colour, its channels in another order, and a little beside it
@given(st.integers(0, 2**31))
def test_gradients_agree_with_finite_differences(name, seed):
    """At colours and latents inside the gamut and away from the places where a formula changes."""
    generator = torch.Generator().manual_seed(seed)
    order = torch.randperm(3, generator=generator)
    # Far from equal channels, and from a lightness of 0.5, where the saturation of HLS has a kink.
    color = torch.tensor([0.25, 0.45, 0.85], dtype=torch.float64)[order]
    color = color + 0.05 * torch.rand(3, generator=generator, dtype=torch.float64)
    space = SPACES[name]
    assert torch.autograd.gradcheck(space.encode, color.requires_grad_(), atol=1e-4)
    assert torch.autograd.gradcheck(space.decode, space.encode(color).detach().requires_grad_(), atol=1e-4)


@pytest.mark.parametrize("name", ["lab", "luv"])
def test_lab_and_luv_agree_with_scikit_image(name):
    scale, offset = (np.array(numbers, dtype=float) for numbers in UNITS[name])
    colors = torch.cat([grid(), 0.02 * grid()])
    expected = (getattr(skimage.color, f"rgb2{name}")(colors.double().numpy()) - offset) / scale
    np.testing.assert_allclose(SPACES[name].encode(colors), expected, atol=1e-5)
    back = getattr(skimage.color, f"{name}2rgb")(expected * scale + offset)
    np.testing.assert_allclose(SPACES[name].decode(torch.from_numpy(expected).float()), back, atol=1e-4)


def by_row(function):
    return lambda colors: np.array([function(*color) for color in colors.tolist()])


@pytest.mark.parametrize(
    ("name", "encode", "decode"),
    [
        ("hsv", skimage.color.rgb2hsv, skimage.color.hsv2rgb),
        ("hls", by_row(colorsys.rgb_to_hls), by_row(colorsys.hls_to_rgb)),
    ],
)
def test_hue_spaces_agree_with_scikit_image_and_colorsys(name, encode, decode):
    colors, latents = torch.cat([grid(), 0.02 * grid()]), grid(13)
    ours, expected = SPACES[name].encode(colors), encode(colors.double().numpy())
    assert hue_distance(ours[:, 0], expected[:, 0]).max() < 1e-5
    np.testing.assert_allclose(ours[:, 1:], expected[:, 1:], atol=1e-5)
    np.testing.assert_allclose(SPACES[name].decode(latents), decode(latents.double().numpy()), atol=1e-5)


@pytest.mark.parametrize("name", ["hsv", "hls"])
def test_cart_is_the_disc_of_hue_and_saturation(name):
    colors = grid()
    polar, cart = SPACES[name].encode(colors), SPACES[f"{name}_cart"].encode(colors)
    hue, saturation = polar[:, 0], polar[:, 1 if name == "hsv" else 2]
    plain, first, second = (2, 0, 1) if name == "hsv" else (1, 0, 2)
    assert torch.equal(cart[:, plain], polar[:, plain])
    x, y = 2 * cart[:, first] - 1, 2 * cart[:, second] - 1
    bound = of_functions(torch.ones(()))  # the latents' own rounding is that of numbers up to 1
    assert_within(x, saturation * torch.cos(2 * torch.pi * hue), bound)
    assert_within(y, saturation * torch.sin(2 * torch.pi * hue), bound)


@pytest.mark.parametrize("name", ["hsv", "hls"])
def test_cart_has_no_jump_at_hue_zero_where_the_polar_space_has_one(name):
    below, above = torch.tensor([0.8, 0.1, 0.1001]), torch.tensor([0.8, 0.1001, 0.1])
    jump = (SPACES[name].encode(below) - SPACES[name].encode(above)).abs().max()
    step = (SPACES[f"{name}_cart"].encode(below) - SPACES[f"{name}_cart"].encode(above)).abs().max()
    assert jump > 0.99
    assert step < 1e-3


@pytest.mark.parametrize("name", ["hsv", "hls"])
@given(st.floats(0.0, 2 * np.pi), st.floats(1.0, 1.4), st.floats(0.1, 0.9))
def test_cart_points_outside_the_disc_decode_as_the_rim(name, angle, radius, other):
    def at(r: float) -> torch.Tensor:
        x, y = 0.5 + 0.5 * r * np.cos(angle), 0.5 + 0.5 * r * np.sin(angle)
        return torch.tensor([x, y, other] if name == "hsv" else [x, other, y], dtype=torch.float32)

    decode = SPACES[f"{name}_cart"].decode
    torch.testing.assert_close(decode(at(radius)), decode(at(1.0)), atol=1e-4, rtol=0)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("shape", [(3,), (0, 3), (2, 4, 5, 3)])
def test_shape_and_dtype_are_kept_and_autocast_changes_nothing(name, shape):
    space = SPACES[name]
    for dtype in (torch.float32, torch.float64):
        colors = torch.rand(shape, dtype=dtype)
        latent = space.encode(colors)
        decoded = space.decode(latent)
        assert latent.shape == decoded.shape == colors.shape
        assert latent.dtype == decoded.dtype == dtype
        with torch.autocast("cpu", dtype=torch.bfloat16):
            assert torch.equal(space.encode(colors), latent)
            assert torch.equal(space.decode(latent), decoded)


def test_every_file_is_a_space_that_says_what_it_is():
    fixed = ["hls", "hls_cart", "hsv", "hsv_cart", "lab", "luv", "rgb"]
    assert sorted(NAMES) == sorted([*fixed, "gain", "log"])
    assert COLOR_SPACES.about("lab") == "CIE L*a*b*, scaled to [0, 1]."
    assert all(f"| {name} " in spaces.__doc__ and COLOR_SPACES.about(name) for name in NAMES)
