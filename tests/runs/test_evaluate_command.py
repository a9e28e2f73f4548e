"""``ctm evaluate`` gives a run's numbers again, to the last digit."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from ctm_plugin.backbones.base import Backbone, Batch, Rendering
from ctm_plugin.cli import main
from ctm_plugin.color.settings import LightConfig
from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.errors import Interrupted
from ctm_plugin.metrics.evaluate import Scoring
from ctm_plugin.metrics.image import psnr
from ctm_plugin.runs.evaluate import evaluate, score
from ctm_plugin.runs.load import load_run
from ctm_plugin.runs.rundir import CONFIG, LAST, METRICS
from ctm_plugin.runs.train import train
from ctm_plugin.settings.registry import BACKBONES, DATASETS
from ctm_plugin.show.console import print_summary

SMALL = ("backbone.coarse=false", "backbone.steps_alone=6", "backbone.grow=[3]", "backbone.occupancy_first=2")
VARIANTS = [
    ("ctm=release", "ctm.pretrain_steps=20", "ctm.k=5"),
    ("ctm=on", "trainer.precision=bf16-mixed"),
    ("ctm=quick", "ctm.pretrain_steps=20", "color_space=log"),
    ("ctm=on", "loss=l1", "color_space=hsv", "dataset.exposure=0.02", "dataset.background=random"),
    ("ctm=off", "backbone.coarse=true", "backbone.coarse_steps=3", "backbone.steps=4"),
]


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS, ids=" ".join)
def test_the_same_numbers_and_pictures(compose, tmp_path, variant, capsys):
    run = tmp_path / "run"
    result = train(compose(*SMALL, *variant), run)
    printed, where = capsys.readouterr().out.split(" scores ")
    assert main(["evaluate", str(run)]) == 0
    assert (run / "evaluation" / METRICS).read_text() == (run / METRICS).read_text()
    assert json.loads((run / METRICS).read_text()) == result
    first, second = (
        {f"{path.parent.name}/{path.name}": path.read_bytes() for path in folder.glob("*/r_*.png")}
        for folder in (run, run / "evaluation")
    )
    assert first == second
    assert len(first) >= 8
    again, where_again = capsys.readouterr().out.split(" scores ")
    assert again.split() == printed.split()
    assert where.endswith(f"written to {run}\nnext: ctm view {run}\n")
    assert where_again.endswith(f"written to {run / 'evaluation'}\nnext: ctm view {run}\n")


@pytest.mark.slow
def test_with_lpips(compose, ctm_data, tmp_path):
    weights = ctm_data / "lpips" / "alexnet_features.npz"
    scene = ("dataset=still_life", "dataset.downscale=4", "dataset.skip=50", f"metrics.lpips_weights={weights}")
    result = train(compose(*SMALL, *scene, "backbone.steps_alone=2", "backbone.grow=[]"), tmp_path)
    assert evaluate(tmp_path) == result
    assert (result["lpips_net"], result["lpips_reason"]) == ("alex", None)
    assert 0 < result["lpips"] < 2
    assert all(view["lpips"] > 0 for view in result["per_image"])


def test_an_interrupted_run_can_be_scored(compose, tmp_path, ctrl_c):
    ctrl_c(lambda seen: seen == 3)
    with pytest.raises(Interrupted):
        train(compose(*SMALL), tmp_path)
    result = evaluate(tmp_path)
    assert result["steps"] == 4
    assert result["psnr"] > 0
    assert not (tmp_path / METRICS).exists()


@pytest.fixture(scope="module")
def dark(compose, tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("dark") / "run"
    train(compose(*SMALL, "ctm=off", "dataset.exposure=0.02"), run)
    return run


def scores_of(folder: Path) -> dict:
    return json.loads((folder / METRICS).read_text())


def test_usage_and_errors(dark, tmp_path, capsys, refused):
    for arguments in ([], ["a", "b"]):
        assert main(["evaluate", *arguments]) == 2
        assert capsys.readouterr().err.endswith("expected RUN_DIR\nusage: ctm evaluate RUN_DIR [key=value ...]\n")
    (tmp_path / CONFIG).write_text((dark / CONFIG).read_text())
    for run, message in (
        ([tmp_path / "nowhere"], "nowhere: found no such directory, expected a run directory"),
        ([dark, "light=bright"], "light: found 'bright', expected auto, off, or a number of stops"),
        ([tmp_path], f"error: {tmp_path}: found no {LAST}, expected a checkpoint\n"),
    ):
        assert message in refused("evaluate", *run)


def test_lit_views_masks_and_missing_pictures(dark, tmp_path):
    run = load_run(dark)
    module, test = run.module, run.module.scene.test
    lit = torch.full(test.images[..., :3].shape, 120, dtype=torch.uint8)
    mask = torch.ones(test.images.shape[:3], dtype=torch.bool)
    mask[:, :1] = False

    def scored(name: str, **light: str) -> dict:
        (tmp_path / name).mkdir()
        return score(module, run.config, tmp_path / name, (None, ""), run.step, run.spent, LightConfig(**light))

    module.scene = replace(module.scene, test=replace(test, lit=lit, mask=mask))
    found = scored("auto")
    assert found["light_factor"] == module.light.gain > 5
    assert (found["light_contrast"], found["light_saturation"]) == (module.light.contrast, module.light.saturation)
    rendered = module.render_view(test, 1)["rgb"].float()
    expected = psnr(module.light.apply(rendered), lit[1].float() / 255, mask[1])
    assert found["per_image"][1]["psnr_lit"] == pytest.approx(float(expected), abs=1e-4)
    assert found["psnr_lit_fitted"] is None or found["psnr_lit_fitted"] >= found["psnr_lit"]
    assert found["psnr"] != scores_of(dark)["psnr"]
    again = scored("stops", light="2")
    assert again["light_factor"] == 4.0
    assert again["psnr_lit"] != found["psnr_lit"]
    assert again["psnr"] == found["psnr"]
    scored("off", light="off")
    kinds = {folder: {path.name for path in (tmp_path / folder).iterdir()} for folder in ("auto", "stops", "off")}
    assert kinds["auto"] == kinds["stops"] == kinds["off"] | {"dark"}
    assert kinds["off"] == {"lit", "photo", "depth", "latent", METRICS}
    module.scene = replace(module.scene, test=replace(module.scene.test, pictured=torch.zeros(len(test)).bool()))
    found = scored("none")
    assert found["psnr"] is found["converged"] is found["constant_psnr"] is found["psnr_lit_photo"] is None
    assert found["psnr_lit"] > 0
    assert "0 test views" in found["protocol"]
    print_summary(found, tmp_path)


def test_a_run_of_few_steps_warns_and_says_what_to_try(dark, tmp_path):
    run = load_run(dark)
    module, test = run.module, run.module.scene.test
    shape = (len(test), 210, 210, test.images.shape[-1])  # flat squares, which have no noise, of all brightnesses
    images = torch.randint(0, 60, shape, dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    images[:, :84] = torch.linspace(0, 60, 210).round().byte()[:, None]
    module.scene = replace(module.scene, test=replace(test, images=images, depth=None))
    with pytest.warns(UserWarning, match="show 0.0. of the real detail .* try trainer=standard"):
        found = score(module, run.config, tmp_path, (None, ""), run.step, run.spent)
    assert 0 <= found["detail"] < 0.1


def test_light_is_a_setting(dark):
    assert main(["evaluate", str(dark), "light=2.5"]) == 0
    result, again = scores_of(dark), scores_of(dark / "evaluation")
    assert again["light_factor"] == pytest.approx(2**2.5)
    assert again["light_contrast"] == again["light_saturation"] == 1.0
    assert {**again, **{key: value for key, value in result.items() if key.startswith("light_")}} == result


@dataclass(frozen=True, kw_only=True)
class GreyConfig:
    level: float = 0.5

    def load(self):
        return SimpleNamespace(name="grey", level=self.level)


@dataclass(frozen=True, kw_only=True)
class BareConfig:
    """A data set with nothing but what it has to have."""

    root: str

    def load(self):
        return BlenderConfig(root=self.root).load()


def test_a_data_set_without_exposure(compose, ball, tmp_path, monkeypatch):
    monkeypatch.setitem(DATASETS.added, "bare", BareConfig)
    config = compose(*SMALL, "ctm=off") | {"dataset": {"name": "bare", "root": str(ball)}}
    result = train(config, tmp_path / "run")
    assert "exposure 1.0, white background" in result["protocol"]
    module = load_run(tmp_path / "run").parts.backbone
    again = module.scores(tmp_path / "again", Scoring())  # by MKL's products, where a run may take oneDNN's
    assert again["psnr"] == pytest.approx(result["psnr"], abs=1e-4)


@dataclass(frozen=True, kw_only=True)
class OneColorConfig:
    steps: int = 3


class OneColor(Backbone):
    """A backbone that renders no views: one colour for a grey world."""

    Config, Scene, batch_rays = OneColorConfig, SimpleNamespace, 4

    def __init__(self, config, scene, transform=None, photometric=None, seed=0):
        super().__init__(transform, photometric, seed)
        self.scene, self.total_steps = scene, config.steps
        self.color = torch.nn.Parameter(torch.zeros(self.channels))

    def draw(self, draws):
        return Batch(torch.full((4, 3), self.scene.level))

    def scene_colors(self, draws, count):
        return torch.full((count, 3), self.scene.level)

    def predict(self, batch, draws):
        return Rendering((self.color.sigmoid().expand(4, -1),))

    def field_optimizers(self):
        return {"color": torch.optim.Adam([self.color])}

    def scores(self, folder, scoring):
        found = self.decode(self.color.sigmoid()[None])
        return {"psnr": 7.0, "error": (found - self.scene.level).abs().max().item()}


@pytest.mark.parametrize("scored", [True, False])
def test_a_backbone_of_another_kind(compose, tmp_path, monkeypatch, capsys, scored):
    monkeypatch.setitem(BACKBONES.added, "one_color", OneColor)
    monkeypatch.setitem(DATASETS.added, "grey", GreyConfig)
    if not scored:
        monkeypatch.delattr(OneColor, "scores")
    config = compose("ctm=off") | {"backbone": {"name": "one_color"}, "dataset": {"name": "grey"}}
    result = train(config, tmp_path / "run")
    assert (result["steps"], result["dataset"], result.get("psnr")) == (3, "grey", 7.0 if scored else None)
    assert evaluate(tmp_path / "run") == result
    assert "not converged" not in capsys.readouterr().out
