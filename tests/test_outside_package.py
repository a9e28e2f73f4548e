"""Another package, on the path as an installed one is: what it offers is used like what is ours."""

import json
import re
from pathlib import Path

import pytest
import torch
import yaml
from forked import Command, execute
from pages import ROOT

from ctm_plugin.cli import main
from ctm_plugin.color.ctm import CTM
from ctm_plugin.color.transform import ColorTransform
from ctm_plugin.runs.assemble import assemble
from ctm_plugin.runs.evaluate import evaluate
from ctm_plugin.runs.load import load_posed
from ctm_plugin.runs.rundir import CONFIG, LAST, METRICS, PREVIOUS, load_config
from ctm_plugin.settings.registry import COLOR_SPACES

RUN = ("dataset=blender", "trainer=smoke", "backbone=glow", "color_space=power", "color_space.middle=0.4")


pytestmark = pytest.mark.usefixtures("installed")


def trained(ball, *arguments: str) -> Path:
    brief = ["ctm.pretrain_steps=20"] if "ctm=quick" in arguments else []
    assert main([*RUN, f"dataset.root={ball}", "hydra.run.dir=run", *arguments, *brief]) == 0
    return Path("run")


def test_the_page_shows_this_space(installed):
    block = next(
        block
        for block in re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "plug_in.md").read_text(), re.S)
        if "class Power" in block
    )
    assert set(block.splitlines()) <= set((installed / "outside_package.py").read_text().splitlines())


def power(run: Path, name: str = LAST) -> torch.Tensor:
    """What was fitted, as a checkpoint has it."""
    state = torch.load(run / name, weights_only=True)["state_dict"]
    return next(value for name, value in state.items() if name.endswith("power"))


def scene_colors(run: Path) -> torch.Tensor:
    return assemble(load_config(run)).backbone.some_colors()


def test_it_is_listed(installed, tmp_path):
    script = f"import sys; sys.path.insert(0, {str(installed)!r}); from ctm_plugin.cli import main; main(['list'])"
    output, _ = Command(script, main=execute, told=tmp_path / "told", COLUMNS="80").communicate()
    shown = [line.split() for line in output.splitlines()]
    assert max(map(len, output.splitlines())) <= 80
    for name in ("power", "glow", "worst", "notes", "count"):
        assert any(name in words[:2] and words[-2:] == ["from", "outside-package"] for words in shown)


@pytest.mark.slow
@pytest.mark.parametrize("ctm", ["off", "quick"])
def test_a_space_is_fitted_once_and_its_numbers_are_in_the_checkpoint(ball, monkeypatch, capsys, ctm):
    run = trained(ball, f"ctm={ctm}", "trainer.checkpoint_every=2")
    expected = torch.tensor(0.4).log() / scene_colors(run).mean(0).log()
    torch.testing.assert_close(power(run), expected, atol=0, rtol=1e-6)
    assert not torch.equal(power(run), torch.ones(3))
    assert yaml.safe_load((run / CONFIG).read_text())["color_space"] == {"name": "power", "middle": 0.4}

    scores = json.loads((run / METRICS).read_text())
    assert scores["worst"] > 0
    monkeypatch.setattr(COLOR_SPACES.get("power"), "begin", lambda self, rgb: pytest.fail("fitted anew"))
    again = evaluate(run)
    assert {name: again[name] for name in ("psnr", "worst")} == {name: scores[name] for name in ("psnr", "worst")}
    shown = load_posed(run).parts.backbone.transform.state_dict()
    assert torch.equal(shown["power" if ctm == "off" else "outer.power"], power(run))
    assert main(["render", str(run), "frames=1", "out=film.gif"]) == 0
    assert main([f"resume={run / PREVIOUS}"]) == 0
    assert torch.equal(power(run), shown["power" if ctm == "off" else "outer.power"])
    assert torch.load(run / LAST, weights_only=True)["global_step"] == scores["steps"]


def test_under_ctm_three_channels_and_nothing_that_learns(ball, monkeypatch, capsys, refused):
    small = [*RUN[:3], f"dataset.root={ball}", "color_space=mine"]
    mine = type("Mine", (ColorTransform,), {"channels": 2})
    monkeypatch.setitem(COLOR_SPACES.added, "mine", mine)
    assert "color_space: found 'mine', expected one of 3 channels under ctm=quick" in refused(*small, "ctm=quick")
    monkeypatch.setitem(COLOR_SPACES.added, "mine", CTM)
    assert main([*small, "ctm=off", "color_space.k=2"]) == 1
    assert "color_space: found 'mine', expected one without parameters" in capsys.readouterr().err


def test_a_space_of_two_channels(ball, monkeypatch):
    coders = {"encode": lambda self, rgb: rgb[..., 1:], "decode": lambda self, latent: latent[..., [0, 0, 1]]}
    monkeypatch.setitem(COLOR_SPACES.added, "mine", type("Mine", (ColorTransform,), {"channels": 2} | coders))
    arguments = [*RUN[:3], f"dataset.root={ball}", "ctm=off", "color_space=mine", "hydra.run.dir=run"]
    assert main(arguments) == 0
    assert evaluate(Path("run"))["color_space"] == "mine"


def test_settings_stand_in_reports(ball, capsys):
    for middle in (0.3, 0.4):
        trained(ball, "ctm=off", f"color_space.middle={middle}", f"hydra.run.dir=runs/{middle}")
    assert main(["report", "runs"]) == 0
    shown = capsys.readouterr().out
    assert all(f"color_space=power middle={middle}" in shown for middle in (0.3, 0.4))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["color_space=powr"], "color_space: found 'powr', expected one of gain, "),
        (["color_space.name=powr"], "unknown color_space 'powr'; known: gain, "),
        (["color_space.middel=1"], "color_space.middel: found an unknown key, expected one of middle, name"),
        (["+color_space.middel=1"], "color_space.middel: found an unknown key, expected one of middle"),
        (["color_space.middle=dark"], "color_space.middle: found 'dark', expected a number"),
        (["color_space.middle=2"], "color_space.middle: found 2.0, expected a number in (0, 1)"),
    ],
)  # fmt: skip
def test_mistakes(ball, refused, arguments, message):
    assert message in refused(*RUN, f"dataset.root={ball}", *arguments)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        ({"begin": lambda self, rgb: self.power.fill_(torch.nan)}, "the scene's colours encoded with NaN or infinity"),
        ({"encode": lambda self, rgb: rgb[:, :2]}, "the scene's colours encoded as [32768, 2], expected [32768, 3]"),
        ({"decode": lambda self, latent: latent[:, :1]}, "the scene's colours decoded again as [32768, 1], expected"),
    ],
)
@pytest.mark.parametrize("ctm", ["off", "quick"])
def test_a_space_that_goes_wrong_is_named_before_training(ball, monkeypatch, refused, spoil, message, ctm):
    for name, method in spoil.items():
        monkeypatch.setattr(COLOR_SPACES.get("power"), name, method)
    monkeypatch.setattr(COLOR_SPACES.get("power"), "losses", lambda *given: pytest.fail("training has begun"))
    assert f"color_space=power: found {message}" in refused(*RUN, f"dataset.root={ball}", f"ctm={ctm}")
