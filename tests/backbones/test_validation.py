"""What users of Lightning expect: validations, tests, and callbacks that watch them."""

from dataclasses import dataclass

import lightning as L
import pytest
import torch
from lightning.pytorch.callbacks import EarlyStopping, ModelCheckpoint

from ctm_plugin.backbones.untouched import snapshot
from ctm_plugin.callbacks.dashboard import Dashboard
from ctm_plugin.metrics.evaluate import Scoring
from ctm_plugin.runs.assemble import assemble
from ctm_plugin.runs.train import train
from ctm_plugin.settings.registry import CALLBACKS

PLANAR = ("backbone=barf2d", "dataset=planar", "dataset.height=40", "dataset.width=50", "dataset.patch=16")
ALL = {
    "dvgo": ("backbone=dvgo", "backbone.coarse=false", "backbone.steps_alone=6", "backbone.grow=[]"),
    "nerf": ("backbone=nerf",),
    "ngp": ("backbone=ngp",),
    "splat": ("backbone=splat",),
    "barf2d": PLANAR,
}


def trainer(*callbacks: L.Callback, **settings) -> L.Trainer:
    """A plain one, which validates after every second step."""
    quiet = dict.fromkeys(("logger", "enable_checkpointing", "enable_progress_bar", "enable_model_summary"), False)
    quiet |= {"val_check_interval": 2, "check_val_every_n_epoch": None, "max_steps": 6, "accelerator": "cpu"}
    return L.Trainer(callbacks=list(callbacks), **quiet | settings)


@pytest.mark.parametrize("name", ALL)
def test_validations_and_tests_of_every_backbone(compose, name):
    """Also before any training, and in its middle, which goes on as if nobody had looked."""
    module, other = (assemble(compose(*ALL[name], "ctm=auto")).backbone for _ in range(2))
    (before,) = trainer().validate(module, verbose=False)
    assert before.keys() >= {"val/psnr"}
    fitted = trainer(Dashboard())
    fitted.fit(module)
    trainer(limit_val_batches=0).fit(other)
    assert all(torch.equal(one, two) for one, two in zip(module.parameters(), other.parameters(), strict=True))
    (after,) = trainer().validate(module, verbose=False)
    assert fitted.callback_metrics["val/psnr"] == pytest.approx(after["val/psnr"])
    each = [snapshot(module, view).scores["psnr"] for view in module.snapshots]
    assert after["val/psnr"] == pytest.approx(sum(each) / len(each))
    (scored,) = trainer().test(module, verbose=False)
    scores = module.scores(None, Scoring())
    assert scored["test/psnr"] == pytest.approx(scores["psnr"])
    assert scored.keys() >= {"test/psnr", "test/depth_mae"} or name == "barf2d"
    assert "loss/total" in fitted.callback_metrics or fitted.log_every_n_steps > 6


def test_the_best_state_is_kept_and_the_rest_is_left_out(compose, tmp_path):
    module = assemble(compose(*ALL["dvgo"], "ctm=auto")).backbone
    best = ModelCheckpoint(tmp_path, monitor="val/psnr", mode="max")
    stop = EarlyStopping("val/psnr", mode="max", patience=0, min_delta=100)  # nothing is ever better by so much
    fitted = trainer(best, stop, Dashboard(), enable_checkpointing=True, log_every_n_steps=1)
    fitted.fit(module)
    assert fitted.global_step == 4
    assert fitted.callback_metrics["loss/total"] > 0
    saved = torch.load(best.best_model_path, weights_only=True)
    assert saved["global_step"] in (2, 4)
    assert float(best.best_model_score) == pytest.approx(float(best.best_k_models[best.best_model_path]))


@dataclass
class Impatient(EarlyStopping):
    """Stops at the second validation."""

    def __post_init__(self) -> None:
        super().__init__("val/psnr", mode="max", patience=0, min_delta=100)


@pytest.mark.parametrize("logger", ["none", "tensorboard"])
def test_a_run_may_be_stopped_by_it_and_keeps_its_last_step(compose, tmp_path, monkeypatch, logger):
    monkeypatch.setitem(CALLBACKS.added, "impatient", Impatient)
    more = ("+callbacks.impatient={}", "trainer.image_every=2", f"logger={logger}", "trainer.checkpoint_every=100")
    result = train(compose(*ALL["dvgo"], "ctm=auto", *more), tmp_path / "run")
    assert result["steps"] == 4
    assert torch.load(tmp_path / "run/checkpoints/last.ckpt", weights_only=True)["global_step"] == 4
