"""What TensorBoard gets: curves by name, and pictures of a test view."""

import io
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import lightning as L
import numpy as np
import pytest
import torch
from lightning.pytorch.loggers import CSVLogger
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from toy import LR, Toy, small_ctm, trainer

from ctm_plugin.callbacks import dashboard
from ctm_plugin.callbacks.ctm import AttachTransform, TransformTraining
from ctm_plugin.callbacks.dashboard import Dashboard
from ctm_plugin.metrics.image import psnr
from ctm_plugin.train import train


class Clock:
    """Goes on by half a second each time it is read."""

    now = 0.0

    def perf_counter(self) -> float:
        self.now += 0.5
        return self.now


class Watched(Toy):
    def stats(self):
        return {"answer": 42.0}


def curves(tmp_path, monkeypatch, *callbacks: L.Callback, log_every: int = 2, **settings) -> dict[int, dict[str, Any]]:
    """What is logged, by step."""
    logged = {}
    monkeypatch.setattr(dashboard, "time", Clock())
    monkeypatch.setattr(CSVLogger, "log_metrics", lambda self, metrics, step=None: logged.update({step: metrics}))
    attach = AttachTransform(small_ctm(), TransformTraining(lr=0.02, lr_decay=0.1))
    logger = CSVLogger(tmp_path)
    trainer(6, attach, Dashboard(log_every, 100), *callbacks, logger=logger, **settings).fit(Watched(6))
    return logged


class Look(L.Callback):
    def __init__(self):
        self.outputs, self.terms = {}, {}

    def on_train_batch_end(self, trainer, pl_module, outputs, *args):
        self.outputs.setdefault(trainer.global_step, outputs)
        self.terms.setdefault(trainer.global_step, pl_module.terms)
        self.transform = pl_module.transform


@pytest.mark.parametrize("accumulate", [1, 2])
def test_curves(tmp_path, monkeypatch, accumulate):
    look = Look()
    logged = curves(tmp_path, monkeypatch, look, accumulate_grad_batches=accumulate)
    assert list(logged) == [2, 4, 6]
    terms = {"enc", "dec", "img", "rand", "latent"}
    tags = {f"loss/{name}" for name in terms | {"total"}} | {"psnr/rgb", "psnr/latent", "lr/field", "lr/ctm"}
    for step, values in logged.items():
        assert values.keys() == tags | {"speed/rays_per_second", "field/answer"}
        assert values["field/answer"] == 42.0
        assert values["lr/field"] == pytest.approx(LR * 0.9 ** (step - 1))
        assert values["lr/ctm"] == pytest.approx(0.02 * 0.1 ** ((step - 1) / 6))
        assert values["speed/rays_per_second"] == 2 * accumulate * Toy.rays / 0.5
        outputs = look.outputs[step]
        assert {name: values[f"loss/{name}"] for name in terms} == {k: float(v) for k, v in look.terms[step].items()}
        assert values["psnr/latent"] == pytest.approx(float(psnr(outputs["latent"][None], outputs["target"][None])))
    with torch.no_grad():
        rgb = look.transform.decode(outputs["latent"]).clamp(0, 1)
    assert values["psnr/rgb"] == pytest.approx(float(psnr(rgb[None], outputs["rgb"][None])))
    assert values["loss/total"] == pytest.approx(sum(values[f"loss/{name}"] for name in terms))


def test_every_step(tmp_path, monkeypatch):
    assert list(curves(tmp_path, monkeypatch, log_every=1)) == [1, 2, 3, 4, 5, 6]


@pytest.fixture(scope="module")
def events(compose, tmp_path_factory) -> EventAccumulator:
    """Of a short run of DVGO."""
    run = tmp_path_factory.mktemp("run")
    sizes = ("backbone.coarse=false", "backbone.steps_alone=4", "backbone.grow=[]", "dataset.exposure=0.1")
    every = ("trainer.log_every=2", "trainer.image_every=4")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ctm_plugin.train.load_lpips", lambda *_: (None, "not asked for"))
        train(compose(*sizes, *every), run)
    return read(run)


def read(run: Path) -> EventAccumulator:
    accumulator = EventAccumulator(str(run / "tensorboard"), {"images": 0, "scalars": 0})
    return accumulator.Reload()


def test_tags_of_a_run(events):
    terms = ("enc", "dec", "img", "rand", "latent", "entropy", "point", "total")
    rates = ("lr/grids/density", "lr/grids/features", "lr/mlp", "lr/ctm")
    scores = ("psnr/rgb", "psnr/latent", "psnr/test_view", "speed/rays_per_second", "field/occupied_fraction")
    assert set(events.Tags()["scalars"]) == {*(f"loss/{term}" for term in terms), *rates, *scores}
    assert [event.step for event in events.Scalars("loss/total")] == [2, 4]
    assert [event.step for event in events.Scalars("psnr/test_view")] == [4]
    names = ("render", "target", "latent", "depth", "error", "render_lifted")
    assert set(events.Tags()["images"]) == {f"test/{name}" for name in names}


def test_pictures_are_of_one_test_view(events):
    pictures = {}
    for tag in events.Tags()["images"]:
        (event,) = events.Images(tag)
        assert event.step == 4
        pictures[tag] = torch.from_numpy(iio.imread(io.BytesIO(event.encoded_image_string))).double() / 255
        assert pictures[tag].shape == (12, 12, 3)
    render, target = pictures["test/render"], pictures["test/target"]
    (score,) = events.Scalars("psnr/test_view")
    assert float(psnr(render[None], target[None])) == pytest.approx(score.value, abs=0.1)  # rounded to 8 bits
    assert float(pictures["test/render_lifted"].mean()) > float(render.mean())
    error = (render - target).abs().mean(-1).flatten()
    brightness = pictures["test/error"].mean(-1).flatten()
    assert np.corrcoef(error, brightness)[0, 1] > 0.5
