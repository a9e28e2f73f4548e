"""More light, and less: the curve, the factors that are found, and what is left as it is."""

import json
import math
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import skimage
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb

from ctm_plugin.color.light import (
    KNEE,
    LUMINANCE,
    MAX_SATURATION,
    MIN_GAIN,
    TARGET_MEAN,
    Light,
    brighten,
    chosen_light,
    enhancement_gain,
    factor_to_mean,
    find_light,
    room,
    shoulder,
    squares,
)
from ctm_plugin.color.settings import LightConfig
from ctm_plugin.color.srgb import linear_to_srgb, srgb_to_linear
from ctm_plugin.errors import ConfigError
from ctm_plugin.metrics.image import psnr

FACTORS = st.floats(1.0, 1000.0)


def floats(level: float = 1.0, seed: int = 0, shape: tuple[int, ...] = (2, 9, 8, 3)) -> torch.Tensor:
    return level * torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def pictures(level: float, seed: int = 0, channels: int = 3) -> torch.Tensor:
    return (255 * floats(level, seed, (3, 20, 24, channels))).round().byte()


@given(st.integers(0, 2**31), st.floats(1e-4, 200.0))
def test_without_a_shoulder_it_agrees_with_kornia(seed, factor):
    image = floats(seed=seed, shape=(6, 5, 3))
    planes = image.permute(2, 0, 1).double()
    expected = linear_rgb_to_rgb((rgb_to_linear_rgb(planes) * factor).clamp(0, 1)).permute(1, 2, 0)
    np.testing.assert_allclose(brighten(image, factor, "hard"), expected, atol=1e-5)


def test_light_taken_comes_back():
    np.testing.assert_allclose(brighten(brighten(floats(), 0.02, "hard"), 50.0, "hard"), floats(), atol=1e-4)


@given(FACTORS)
def test_the_shoulder_bends_from_the_knee_to_white(white):
    light = torch.linspace(0, white, 5001, dtype=torch.float64)
    bent = shoulder(light, white)
    assert bent[0] == 0
    assert bent[-1] == pytest.approx(1.0, abs=1e-12)
    assert torch.equal(bent[light <= KNEE], light[light <= KNEE])
    assert (bent.diff() > 0).all()
    assert (bent <= light + 1e-12).all()


@pytest.mark.parametrize("white", [1.5, 20.0, 1000.0])
def test_value_and_slope_are_continuous_at_the_knee(white):
    light = torch.tensor([KNEE - 1e-6, KNEE, KNEE + 1e-6], dtype=torch.float64)
    np.testing.assert_allclose(shoulder(light, white).diff() / light.diff(), 1.0, atol=1e-4)


def test_one_is_the_limit_of_lamps():
    """Reinhard's curve without white is t / (1 + t)."""
    light = torch.tensor([1.0, 10.0, 1e5], dtype=torch.float64)
    t = (light - KNEE) / (1 - KNEE)
    np.testing.assert_allclose(shoulder(light, 1e12), KNEE + (1 - KNEE) * t / (1 + t), rtol=1e-6)


@pytest.mark.parametrize("clip", ["shoulder", "hard"])
@given(st.floats(1e-3, 1000.0), st.floats(1e-3, 1000.0))
def test_brighter_pictures_and_larger_factors_are_brighter(clip, first, second):
    image = torch.linspace(0, 1, 301, dtype=torch.float64)
    less, more = (brighten(image, factor, clip) for factor in sorted((first, second)))
    assert (less <= more + 1e-12).all()
    assert (more.diff() >= -2e-7).all()  # sRGB's two pieces meet so closely
    assert more[0] == 0
    assert max(first, second) < 1 or more[-1] == pytest.approx(1)


def test_one_changes_nothing_and_below_the_knee_light_is_multiplied():
    image = floats().double()
    np.testing.assert_allclose(brighten(image, 1.0), image, atol=1e-12)
    for part, factor in ((0.1, 20.0), (1.0, 0.25)):
        np.testing.assert_allclose(brighten(part * image, factor), brighten(part * image, factor, "hard"), atol=1e-12)


LIGHTS = st.builds(Light, st.floats(0.1, 1000.0), st.floats(0.5, 2.0))


@given(st.floats(0.02, 0.5), st.integers(0, 1000))
def test_the_mean_of_grey_copies_is_reached(level, seed):
    levels = pictures(level, seed).double().flatten() / 255
    factor = factor_to_mean(levels, torch.ones_like(levels))
    assert float(brighten(levels, factor).mean()) == pytest.approx(TARGET_MEAN.at, abs=1e-6)


@given(LIGHTS)
def test_it_rises_from_black_to_white(light):
    grey = torch.linspace(0, 1, 2001, dtype=torch.float64)[:, None].expand(-1, 3)
    lit = light.apply(grey)
    assert lit[0].max() == 0
    assert (lit.diff(dim=0) > -1e-7).all()  # sRGB's two pieces meet so closely
    assert (lit[20:-20].diff(dim=0) > 0).all()
    assert (lit[:-1] < 1).all()
    assert light.gain < 1 or lit[-1] == pytest.approx(1.0)


@given(LIGHTS, st.floats(0.5, 2.0))
def test_greys_stay_grey_and_colours_change_by_their_distance(light, saturation):
    light = Light(light.gain, light.contrast, saturation)
    grey = floats(shape=(50, 1)).double().expand(-1, 3)
    lit = light.apply(grey)
    np.testing.assert_allclose(lit, lit[:, :1].expand(-1, 3), atol=1e-6)
    dull = (0.1 * floats(shape=(50, 3)) + 0.3).double()
    before, after = (srgb_to_linear(each) for each in (dull, Light(saturation=saturation).apply(dull)))
    distances = (each - (each @ each.new_tensor(LUMINANCE))[:, None] for each in (saturation * before, after))
    np.testing.assert_allclose(*distances, atol=2e-4)  # 3e-5 of light take a thousandth of them
    none = Light(saturation=0.0).apply(dull)
    np.testing.assert_allclose(none, none[:, :1].expand(-1, 3), atol=1e-6)


def test_without_contrast_and_saturation_it_brightens_and_the_least_does_nothing():
    image = floats()
    grey = image[..., :1].expand(-1, -1, -1, 3)
    torch.testing.assert_close(Light(20.0).apply(grey), brighten(grey, 20.0))
    assert Light().apply(image) is image


@pytest.mark.parametrize("level", [1e-6, 3e-5, 3e-3])
def test_colours_next_to_black_fade_into_grey(level):
    """To half at 3e-5 of light, and the luminance stays."""
    light = level * torch.tensor([[1.5, 1.0, 0.5]]).double()
    grey = float(light @ light.new_tensor(LUMINANCE))
    shown = srgb_to_linear(Light(gain=100.0).apply(linear_to_srgb(light))) / 100
    np.testing.assert_allclose(shown - grey, (light - grey) * grey / (grey + 3e-5), atol=1e-3 * level)


def scene(exposure: float, seed: int = 0) -> torch.Tensor:
    """Smooth coloured pictures ``[3, 96, 120, 3]`` under less light, of 16 bits."""
    coarse = torch.rand(3, 3, 6, 7, generator=torch.Generator().manual_seed(seed))
    lit = torch.nn.functional.interpolate(coarse, (96, 120), mode="bilinear").permute(0, 2, 3, 1)
    return linear_to_srgb(exposure * srgb_to_linear(0.1 + 0.8 * lit))


def aims(light: Light, pictures: torch.Tensor) -> float:
    values = light.apply(pictures).double().flatten().sort().values
    top = values[-len(values) // 10 :]
    cost = ((values.mean() - 0.45) / 0.05) ** 2 + ((top.mean() - 0.8) / 0.025) ** 2
    return float(cost + ((values.std() - 0.2) / 0.05) ** 2) + (math.log(light.contrast) / 0.2) ** 2


@pytest.mark.parametrize("exposure", [0.2, 0.02, 0.005])
def test_no_gain_and_no_contrast_nearby_is_better(exposure):
    dark = scene(exposure)
    found = find_light(dark)
    assert found.gain * exposure == pytest.approx(find_light(scene(0.02)).gain * 0.02, rel=0.1)
    for gain in (found.gain / 1.1, found.gain * 1.1):
        assert aims(found, dark) < aims(Light(gain, found.contrast, found.saturation), dark)
    for contrast in (found.contrast + 0.1, *([found.contrast - 0.1] if found.contrast > 1.1 else [])):
        assert aims(found, dark) < aims(Light(found.gain, contrast, found.saturation), dark)


def test_pale_pictures_get_colour_and_vivid_ones_keep_theirs():
    grey, vivid = scene(0.02).mean(-1, keepdim=True).expand(-1, -1, -1, 3), scene(0.02) * torch.tensor([1.0, 0.3, 0.3])
    assert find_light(0.95 * grey + 0.05 * scene(0.02)).saturation == MAX_SATURATION
    assert find_light(vivid).saturation == 1.0


def test_neither_order_nor_type_nor_the_bytes_make_a_difference():
    dark = (scene(0.05) * 255).round().byte()
    found = find_light(dark)
    assert find_light(dark.flip(0)) == find_light(dark.flip(0, 1, 2)) == found
    assert find_light(dark.float() / 255) == found
    assert find_light(dark.flatten(0, 2)).gain == pytest.approx(found.gain, rel=0.1)


@pytest.mark.parametrize("kind", ["lit", "black"])
def test_what_is_lit_stays_and_so_does_black(kind):
    assert find_light(scene(float(kind == "lit"))) == Light()


@pytest.mark.parametrize(("stops", "share"), [(4.0, 0.08), (6.0, 0.3)])
def test_windows_decide_nothing(stops, share):
    dark, window = scene(0.005), torch.zeros(3, 96, 120, dtype=torch.bool)
    window[:, :, : int(120 * share)] = True
    dark[window] = linear_to_srgb(torch.tensor(2.0**stops * 0.005 * 0.25))
    light = find_light(dark)
    assert light == find_light(dark, ~window)
    assert light.apply(dark[window]).min() > 0.9 > light.apply(dark[window]).max() - 0.1


def test_what_is_bright_in_a_scene_of_many_stops_belongs_to_it():
    stops = torch.randn(20_000, 1, generator=torch.Generator().manual_seed(0)).expand(-1, 3)
    counts = torch.ones(len(stops), dtype=torch.float64)
    assert float(room(2 ** (2.4 * stops - 9), counts).double().mean()) > 0.99
    assert room(torch.zeros(5, 3), counts[:5]).all()


def test_light_that_would_be_little_is_none():
    assert find_light(scene(0.8)) == Light()
    assert find_light(scene(0.3)).gain >= MIN_GAIN


def test_one_bright_pixel_is_not_brightened_beyond_the_largest():
    one_pixel = torch.zeros(1, 10, 10, 3, dtype=torch.uint8)
    one_pixel[0, 0] = 40
    assert 1 <= find_light(one_pixel).gain <= 1024


def test_transparent_and_masked_pixels_do_not_count():
    dark = (scene(0.05) * 255).round().byte()
    mask = torch.zeros(dark.shape[:3], dtype=torch.bool)
    mask[:, 11:71, 7:90] = True
    loud = dark.clone()
    loud[~mask] = 255
    behind = torch.cat([loud, 255 * mask[..., None].byte()], dim=-1)
    expected = find_light(dark, mask)
    assert expected != Light()
    assert find_light(loud, mask) == find_light(behind) == expected
    assert squares(loud, mask)[1].sum() == mask.sum()


def test_squares_are_means_of_light():
    image = floats(shape=(1, 200, 300, 3))
    means, counts, view, at = squares(image)
    expected = srgb_to_linear(image[0]).reshape(100, 2, 150, 2, 3).mean((1, 3)).flatten(0, 1)
    torch.testing.assert_close(means, expected, atol=1e-6, rtol=0)
    assert counts.unique().tolist() == [4.0]
    assert view.unique().tolist() == [0]
    torch.testing.assert_close(
        at[[0, 1, 150]], torch.tensor([[1 / 300, 1 / 200], [3 / 300, 1 / 200], [1 / 300, 3 / 200]])
    )


def read(path: Path) -> torch.Tensor:
    return torch.from_numpy(iio.imread(path)[..., :3])


def test_dark_photographs_come_near_those_in_normal_light(ctm_data):
    """One factor to a mean of 0.45 gives 22.9 dB."""
    found = []
    for name in ("buu", "chair", "bike"):
        root = ctm_data / "lom" / name
        train, test = (
            [Path(frame["file_path"]).name for frame in json.loads(path.read_text())["frames"]]
            for path in (root / "transforms_train.json", root / "transforms_test.json")
        )
        light = find_light(torch.stack([read(root / "low" / name) for name in train]))
        pairs = [(light.apply(read(root / "low" / name) / 255), read(root / "high" / name) / 255) for name in test]
        found.append(np.mean([float(psnr(*pair)) for pair in pairs]))
    assert np.mean(found) >= 24.0


def test_a_room_with_bright_windows_is_lit_as_in_normal_light(ctm_data):
    """A factor of 151 gives it the mean of its photograph in normal light."""
    root = ctm_data / "realx3d" / "MilkCookie"
    train = json.loads((root / "transforms_train.json").read_text())["frames"][::5]
    light = find_light(torch.stack([read(root / frame["file_path"]) for frame in train]))
    assert math.log2(light.gain / 151) == pytest.approx(0, abs=1 / 3)


@pytest.mark.parametrize(("bits", "noise"), [(16, 0.0), (8, 0.0), (8, 2e-4)])
def test_brackets_come_out_alike(bits, noise):
    """A quarter, and 1/2, 1/8 and 1/32 of that; the weakest fills 6 levels of 8 bits."""
    lit = srgb_to_linear(scene(1.0))
    draws = torch.randn(lit.shape, generator=torch.Generator().manual_seed(0))
    shown = []
    for exposure in (1 / 4, 1 / 8, 1 / 32, 1 / 128):
        dark = linear_to_srgb((exposure * lit + noise * draws).clamp(0, 1))
        dark = dark if bits == 16 else (dark * 255).round() / 255
        light = find_light(dark)
        blurred = torch.nn.functional.avg_pool2d(light.apply(dark).permute(0, 3, 1, 2), 8).permute(0, 2, 3, 1)
        shown.append((math.log2(light.gain * exposure), light.contrast, blurred))
    for stops, contrast, blurred in shown[1:]:
        assert stops == pytest.approx(shown[0][0], abs=0.081)  # two of the steps that are tried
        assert contrast == pytest.approx(shown[0][1], abs=0.041)
        assert psnr(blurred, shown[0][2]).min() > 30


@pytest.mark.parametrize("name", ["astronaut", "coffee", "chelsea", "motorcycle_left"])
def test_well_exposed_photographs_come_back(name):
    """At 1/30 of the light; half a stop beside the truth would give about 20 dB."""
    photograph = (
        torch.from_numpy(iio.imread(Path(skimage.__file__).parent / "data" / f"{name}.png")[::3, ::3, :3]) / 255
    )
    dark = linear_to_srgb(srgb_to_linear(photograph) / 30)[None]
    light = find_light(dark)
    assert math.log2(light.gain / 30) == pytest.approx(0, abs=0.5)
    assert float(psnr(light.apply(dark[0]), photograph)) > 25
    assert find_light(photograph[None]) == Light()


AUTO = Light(30.0, 1.2, 1.1)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, AUTO), ({"light": "off"}, Light()), ({"light": "3"}, Light(8.0)), ({"light": "-1"}, Light(0.5)),
        ({"contrast": 1.5}, Light(30.0, 1.5, 1.1)), ({"saturation": 0.0}, Light(30.0, 1.2, 0.0)),
        ({"light": "off", "contrast": 1.5, "saturation": 0.5}, Light(1.0, 1.5, 0.5)),
    ],
)  # fmt: skip
def test_settings(given, expected):
    assert chosen_light(LightConfig(**given), AUTO) == expected


@pytest.mark.parametrize("light", ["bright", "", "nan", "inf", "11", "-10.5"])
def test_other_settings_are_refused(light):
    with pytest.raises(ConfigError, match=r"light: found .*, expected auto, off, or a number of stops"):
        LightConfig(light=light)


@pytest.mark.parametrize(
    ("targets", "exposure", "gain"),
    [
        (floats(), 0.02, 50.0), (floats(), 2.0, 0.5),
        (torch.ones(1, 4, 4, 3), None, pytest.approx(1.0, abs=1e-6)), (torch.zeros(1, 4, 4, 3), None, 1.0),
    ],
)  # fmt: skip
def test_gain_for_scores(targets, exposure, gain):
    """The inverse of an exposure that is known; about one for what is bright, or all black."""
    assert enhancement_gain(targets, exposure) == gain


@pytest.mark.parametrize("exposure", [None, 1.0])
def test_gain_brings_the_99th_percentile_of_the_whole_set_to_white(exposure):
    targets = floats(0.2, shape=(4, 20, 25, 3))
    gain = enhancement_gain(targets, exposure)
    white = brighten(targets, gain, "hard").flatten() > 1 - 1e-4
    assert float(white.double().mean()) == pytest.approx(0.01, abs=0.001)
    assert enhancement_gain(list(targets), exposure) == gain


@pytest.mark.parametrize("exposure", [0.0, -1.0, math.nan, math.inf])
def test_gain_refuses_an_exposure_that_is_not_positive(exposure):
    with pytest.raises(ConfigError, match="exposure: found"):
        enhancement_gain(floats(), exposure)
