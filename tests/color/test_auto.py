"""The recommended colours: a logarithm whose bend is bounded."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.color.auto import Auto, toe
from ctm_plugin.color.settings import AutoConfig
from ctm_plugin.color.srgb import linear_to_srgb
from ctm_plugin.compose.command_line import compose
from ctm_plugin.errors import ConfigError
from ctm_plugin.settings.registry import COLOR_SPACES


def plain(**given: object) -> AutoConfig:
    """Settings under which each test has one thing at work."""
    return AutoConfig(
        **{"steepest": 2.0, "empty": 0.0, "middle": 0.5, "lowest": 0.0, "fills": 0.5, "black": 0.0} | given
    )


def test_in_python_it_is_what_the_command_line_recommends():
    composed = compose("ctm=auto")["ctm"]
    assert Auto().config == AutoConfig(**{key: composed[key] for key in AutoConfig.__dataclass_fields__})


def scene(top: float, power: float) -> torch.Tensor:
    """Colours from black to ``top``, their median at ``top / 2^power``."""
    return top * torch.rand(4000, 3, generator=torch.Generator().manual_seed(0)) ** power


def fitted(rgb: torch.Tensor, *settings: dict) -> list[Auto]:
    """One for each, of the same scene."""
    found = [Auto(plain(**each)) for each in settings]
    for each in found:
        each.begin(rgb)
    return found


def slopes(fit: Auto) -> tuple[float, float]:
    """Of the curve at black and at the level."""
    color = torch.stack([torch.zeros(3), fit.level.expand(3)]).double().requires_grad_()
    (slope,) = torch.autograd.grad(fit.encode(color).sum(), color)
    return float(slope[0, 0]), float(slope[1, 0])


@given(st.sampled_from([0.01, 0.1, 0.5]), st.sampled_from([2.0, 4.0]), st.sampled_from([1.5, 3.0, 8.0]))
def test_the_slope_at_black_is_so_many_of_that_at_the_level(top, power, steepest):
    (fit,) = fitted(scene(top, power), {"steepest": steepest, "black": 0.3})
    black, level = slopes(fit)
    steepest += toe(top)
    assert black / level <= steepest + 1e-4
    median = float(fit.encode(scene(top, power)).median() - fit.black)
    assert black / level == pytest.approx(steepest, abs=1e-4) or median == pytest.approx(0.25, abs=1e-3)


@pytest.mark.parametrize(
    ("light", "expected"), [(1.0, 0), (0.02, 0), (0.0101, 0), (0.005, 1.98), (0.003, 4), (1e-4, 4)]
)
def test_a_very_dark_scene_is_bent_as_srgb_no_longer_bends_it(light, expected):
    """By the slopes of the curve itself, in light."""
    there = torch.tensor([1e-6, light], dtype=torch.float64, requires_grad=True)
    stored = linear_to_srgb(there)
    black, level = torch.autograd.grad(stored.sum(), there)[0].tolist()
    more = toe(float(stored.detach()[1]))
    assert more == pytest.approx(expected, abs=0.01)
    assert more == pytest.approx(max(0, 4 * (2 * level / black - 1)), abs=1e-3)


@pytest.mark.parametrize(("share", "steepest"), [(0.0, 1.0), (0.7, 3.0)])
def test_so_dark_it_bends_without_black_too(share, steepest):
    fit = Auto(plain(empty=0.25, steepest=3.0, black=0.3))
    for darker, more in ((1.0, 0.0), (0.2, 4.0)):
        fit.begin(darker * before_black(share))
        black, level = slopes(fit)
        assert black / level == pytest.approx(steepest + more, abs=1e-3)


@given(st.sampled_from([2.0, 5.0, 8.0]), st.sampled_from([0.1, 0.2, 0.4]))
def test_the_median_is_brought_so_far_at_least(power, lowest):
    """However steep: where few places are much brighter than all others."""
    mild, fit = fitted(scene(0.4, power), {"middle": 0.4}, {"middle": 0.4, "lowest": lowest})
    if (there := float(mild.encode(scene(0.4, power)).median() / mild.top)) >= lowest:
        assert torch.equal(fit.a, mild.a)
    else:
        assert fit.a > mild.a
        there = float(fit.encode(scene(0.4, power)).median() / fit.top)
        assert there == pytest.approx(lowest, abs=1e-3)


@pytest.mark.parametrize("level", [1.0, 0.3, 0.02])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_fewer_operators_give_the_curve_of_the_base(level, dtype):
    fit, rgb = Auto(plain(black=0.7, lowest=0.4)), scene(level, 4.0).to(dtype)
    fit.begin(rgb)
    assert fit.encode(rgb).dtype == dtype
    torch.testing.assert_close(fit.encode(rgb), super(Auto, fit).encode(rgb), atol=1e-7, rtol=0)
    loaded = Auto(fit.config)
    loaded.load_state_dict(fit.state_dict())
    torch.testing.assert_close(loaded.encode(rgb), fit.encode(rgb), atol=1e-7, rtol=0)


def before_black(share: float) -> torch.Tensor:
    """As many colours again as a dark scene has, so that this share of all is black."""
    rgb = scene(0.2, 3.0).clamp_min(1e-3)
    return torch.cat([rgb, torch.zeros(round(len(rgb) * share / (1 - share)), 3)])


@pytest.mark.parametrize(("share", "bent"), [(0.0, False), (0.2, False), (0.3, True), (0.7, True)])
def test_it_bends_where_so_much_is_black(share, bent):
    settings = {"empty": 0.25}, {"steepest": 1.0}, {}
    fit, gain, always = fitted(before_black(share), *({"black": 0.3} | each for each in settings))
    assert torch.equal(fit.a, (always if bent else gain).a)
    assert always.a > 0.5 > gain.a


@pytest.mark.parametrize(("top", "bent"), [(0.3, True), (1.0, False)])
def test_lit_scenes_are_not_bent_for_their_black(top, bent):
    fit, rgb = Auto(plain(empty=0.25, black=0.3)), torch.cat([scene(top, 4.0), torch.zeros(4000, 3)])
    fit.begin(rgb)
    assert (float(fit.a) > 0.5) == bent
    assert torch.equal(fit.encode(rgb), rgb) != bent


def test_beside_a_lamp_it_bends_without_black_too():
    mild, fit = fitted(scene(0.4, 8.0).clamp_min(1e-4), {"lowest": 0.2}, {"lowest": 0.2, "empty": 0.25})
    assert fit.a > mild.config.steepest
    assert torch.equal(fit.a, mild.a)


def test_the_lowest_median_is_no_higher_than_the_middle():
    mild, fit = fitted(scene(0.2, 4.0), {"middle": 0.3, "steepest": 1e4}, {"middle": 0.3, "lowest": 0.9})
    assert float(fit.a) == pytest.approx(float(mild.a))


@pytest.mark.parametrize("power", [1.1, 4.0])
def test_it_is_the_logarithm_where_that_bends_less(power):
    fit, full = Auto(plain()), COLOR_SPACES.get("log")()
    fit.begin(scene(0.1, power))
    full.begin(scene(0.1, power))
    assert (float(fit.a) == pytest.approx(float(full.a))) == (float(full.a) <= 1.0)
    assert float(fit.a) <= 1.0 + 1e-6


@pytest.mark.parametrize("fills", [0.5, 0.9])
def test_one_is_a_gain_alone(fills):
    fit, gain = Auto(plain(steepest=1.0, fills=fills)), COLOR_SPACES.get("gain")()
    for each in (fit, gain):
        each.begin(scene(0.1, 3.0))
    expected = gain.encode(scene(0.1, 1.0)) * fills / 0.9
    torch.testing.assert_close(fit.encode(scene(0.1, 1.0)), expected, atol=1e-3, rtol=0)


@pytest.mark.parametrize(("fills", "black"), [(0.1, 0.3), (0.5, 0.3), (0.9, 0.0)])
def test_a_bright_scene_is_left_as_it_is(fills, black):
    fit, rgb = Auto(plain(fills=fills, black=black)), scene(1.0, 0.5)
    fit.begin(rgb)
    assert torch.equal(fit.encode(rgb), rgb)
    assert torch.equal(fit.decode(rgb), rgb)
    assert fit.filled == fit.behind == (0.0, 1.0)


@pytest.mark.parametrize(("brightest", "top"), [(0.01, 0.1), (0.3, 0.3)])
def test_a_dark_scene_is_raised_so_far_and_a_brighter_one_stays(brightest, top):
    (fit,) = fitted(scene(brightest, 3.0), {"fills": 0.1, "black": 0.3})
    ends = fit.encode(torch.stack([torch.zeros(3), fit.level.expand(3)]))
    assert ends[:, 0].tolist() == pytest.approx([0.3 * top, 1.3 * top], rel=1e-3)
    assert torch.stack(fit.filled).tolist() == pytest.approx(ends[:, 0].tolist(), rel=1e-6)
    assert torch.stack(fit.behind).tolist() == pytest.approx([0.2 * top, 0.4 * top], rel=1e-3)


def test_backgrounds_round_a_black_near_the_end_stay_in_the_range():
    (fit,) = fitted(scene(0.3, 3.0), {"fills": 0.1, "black": 0.05})
    assert torch.stack(fit.behind).tolist() == pytest.approx([0.0, 0.03], rel=1e-3)


@given(st.sampled_from([0.003, 0.1, 1.0]), st.sampled_from([0.5, 2.0]), st.sampled_from([0.1, 0.5]), st.floats(0, 1))
def test_all_colours_come_back_and_black_is_black(top, power, fills, black):
    (fit,) = fitted(scene(top, power), {"fills": fills, "black": black})
    colors = torch.cat([scene(1.0, 1.0), scene(top, 1.0), torch.zeros(1, 3)])
    torch.testing.assert_close(fit.decode(fit.encode(colors)), colors, atol=1e-6, rtol=0)
    nothing = torch.zeros(1, 3)
    assert torch.equal(fit.decode(fit.encode(nothing)), nothing)
    assert torch.equal(fit.decode(nothing), nothing)  # below black


def test_what_it_found_is_told_and_kept():
    fit, other = Auto(plain()), Auto(plain())
    fit.begin(scene(0.1, 4.0))
    other.load_state_dict(fit.state_dict())
    assert other.describe() == fit.describe()
    assert other.describe() == "gain 5, bent by 1"
    dark = Auto(plain(black=0.3))
    dark.load_state_dict(fit.state_dict())
    assert dark.describe() == "gain 5, bent by 1, black at 0.15"


@given(st.sampled_from([1.0, 2.0, 4.0]), st.sampled_from([0.2, 0.4, 0.5]))
def test_the_median_comes_to_the_middle_or_stays_above(power, middle):
    fit, rgb = Auto(plain(steepest=1e4, middle=middle, black=0.3)), scene(0.1, power)
    fit.begin(rgb)
    unbent = float(rgb.median() / fit.level)
    assert 2 * float(fit.encode(rgb).median() - fit.black) == pytest.approx(max(unbent, middle), abs=2e-3)


def test_a_black_that_lifts_the_range_above_one_is_refused():
    assert plain(fills=0.8, black=0.25).black == 0.25
    with pytest.raises(ConfigError, match=r"ctm.black: found 0.3, expected a number in \[0, 0.25\]"):
        plain(fills=0.8, black=0.3)
    with pytest.raises(ConfigError, match=r"ctm.photometric: found 'l2', expected one of mse, l1"):
        plain(photometric="l2")


def test_one_word_sets_what_goes_with_it_for_each_backbone():
    """BARF's loss, and DVGO's thresholds; what is said is what was said."""
    found = {backbone: compose("ctm=auto", f"backbone={backbone}") for backbone in ("dvgo", "nerf", "ngp", "barf2d")}
    kinds = {backbone: config["loss"]["kind"] for backbone, config in found.items()}
    assert kinds == {"dvgo": "mse", "nerf": "mse", "ngp": "mse", "barf2d": "l1"}
    assert found["dvgo"]["backbone"]["relative"] is True
    assert found["barf2d"]["ctm"] != found["dvgo"]["ctm"]
    assert compose("ctm=auto", "backbone=barf2d", "loss=mse")["loss"]["kind"] == "mse"
    assert compose("ctm=on", "backbone=barf2d")["loss"]["kind"] == "mse"
    assert compose("ctm=auto", "backbone=dvgo", "backbone.relative=false")["backbone"]["relative"] is False
